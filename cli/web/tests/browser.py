"""Clicks on a live page in Chromium, by chromedriver: browser.py URL#TOKEN PICTURE.

Speaks WebDriver (https://www.w3.org/TR/webdriver2/), which is JSON over HTTP.
"""

import base64
import json
import subprocess
import sys
import tempfile
import time
import urllib.request

URL, PICTURE = sys.argv[1:]
# The test that starts this program has a watchdog too.
WITHIN_S = 100
OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))
# The name of an element in an answer, by the standard.
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"


def options(folder):
    """Returns the options of a browser without window, without network and without a profile."""
    words = [
        "headless", "no-sandbox", "disable-gpu", "disable-quic", "no-first-run",
        "disable-background-networking", "disable-component-update", "disable-sync",
        f"user-data-dir={folder}", "window-size=1200,1700",
    ]
    return {"args": [f"--{word}" for word in words]}


class Browser:
    """A session of chromedriver."""

    def __init__(self, port, folder):
        self.base = f"http://127.0.0.1:{port}"
        wanted = {"goog:chromeOptions": options(folder), "goog:loggingPrefs": {"browser": "ALL"}}
        session = self.ask("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self.base += f"/session/{session['sessionId']}"

    def ask(self, method, path, body=None):
        """Returns the value of an answer."""
        data = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        request = urllib.request.Request(self.base + path, data, headers, method=method)
        with OPENER.open(request, timeout=60) as answer:
            return json.load(answer)["value"]

    def script(self, text):
        """Runs a script in the page, and returns its value."""
        return self.ask("POST", "/execute/sync", {"script": text, "args": []})

    def until(self, what, text):
        """Waits until a script returns a value that counts as true, and returns it."""
        begin = time.monotonic()
        while not (value := self.script(text)):
            shown = self.script("return document.body.innerText")
            assert time.monotonic() < begin + WITHIN_S, f"{what} never came:\n{shown}"
            time.sleep(0.05)
        return value

    def click(self, selector):
        """Clicks on an element, as a user does."""
        found = self.ask("POST", "/element", {"using": "css selector", "value": selector})
        self.ask("POST", f"/element/{found[ELEMENT]}/click", {})


def text_of(name):
    """Returns a script that returns the text of an element."""
    return f"document.getElementById('{name}').innerText"


def check(browser):
    """Kills the master's supply by a click, and returns when the page shows the takeover."""
    browser.ask("POST", "/url", {"url": URL})
    both = " && ".join(f"/\\b{role}\\b/.test(both)" for role in ["master", "standby"])
    both = f"const both = {text_of('system_a')} + ' ' + {text_of('system_b')}; return {both}"
    browser.until("both roles", both)
    assert not browser.script("return location.hash"), "the token is still in the address"
    browser.click("button[data-hand='kill-supply'][data-system='master']")
    # On a busy machine the driver may have changed since: the answer says which one was killed.
    killed = browser.until("the answer", f"return {text_of('said')}")
    assert killed in ["kill the supply of A", "kill the supply of B"], killed
    other = {"A": "B", "B": "A"}[killed[-1]]
    browser.until("the takeover", f"return document.body.dataset.obeyed === '{other}'")
    seen = f"return {text_of('system_' + other.lower())}.includes('the vehicle obeys it')"
    browser.until("the takeover on the page", seen)
    browser.until("the event", f"return {text_of('events')}.includes('takes over')")
    # So much of the time after it is in the picture.
    time.sleep(2)
    with open(PICTURE, "wb") as file:
        file.write(base64.b64decode(browser.ask("GET", "/screenshot")))
    errors = [it for it in browser.ask("POST", "/se/log", {"type": "browser"})
              if "favicon" not in it["message"]]
    assert not errors, errors


def main():
    """Starts chromedriver on a free port, and ends it."""
    with tempfile.TemporaryDirectory() as folder:
        driver = subprocess.Popen(["chromedriver", "--port=0"], stdout=subprocess.PIPE, text=True)
        try:
            ready = next(line for line in driver.stdout if "started successfully on port" in line)
            browser = Browser(int(ready.rstrip(".\n").split()[-1]), folder)
            try:
                check(browser)
            finally:
                browser.ask("DELETE", "")
        finally:
            driver.terminate()
            driver.wait()


main()
