"""Chromium without a window, by chromedriver, for tests of pages.

Speaks WebDriver (https://www.w3.org/TR/webdriver2/), which is JSON over HTTP.
"""

import base64
import contextlib
import json
import subprocess
import tempfile
import time
import urllib.request

# The tests that start these programs have a watchdog too.
WITHIN_S = 100
OPENER = urllib.request.build_opener(urllib.request.ProxyHandler({}))
# The name of an element in an answer, by the standard.
ELEMENT = "element-6066-11e4-a52e-4f735466cecf"
# Runs in the page: the texts whose contrast to their background is below WCAG's 4.5, with it.
PALE_TEXTS = """
const rgb = (text) => {
  const found = text.match(/[\\d.]+/g).map(Number);
  return { color: found.slice(0, 3), alpha: found.length > 3 ? found[3] : 1 };
};
const light = (color) => {
  const [r, g, b] = color.map((it) => it / 255)
    .map((it) => (it <= 0.04045 ? it / 12.92 : ((it + 0.055) / 1.055) ** 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
};
const contrast = (a, b) => {
  const [low, high] = [light(a), light(b)].sort((x, y) => x - y);
  return (high + 0.05) / (low + 0.05);
};
const behind = (node) => {
  for (let it = node; it !== null; it = it.parentElement) {
    const { color, alpha } = rgb(getComputedStyle(it).backgroundColor);
    if (alpha === 1) return color;
  }
  return rgb(getComputedStyle(document.body).backgroundColor).color;
};
const pale = [];
let count = 0;
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const node = walker.currentNode;
  const parent = node.parentElement;
  if (node.data.trim() === "" || parent.getClientRects().length === 0) continue;
  const style = getComputedStyle(parent);
  const isDrawn = parent instanceof SVGElement;
  const ratio = contrast(rgb(isDrawn ? style.fill : style.color).color, behind(parent));
  count += 1;
  if (ratio < 4.5) pale.push(`${node.data.trim().slice(0, 40)}: ${ratio.toFixed(2)}`);
}
return { count, pale: [...new Set(pale)] };
"""


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
        logs = {"browser": "ALL", "performance": "ALL"}
        wanted = {"goog:chromeOptions": options(folder), "goog:loggingPrefs": logs}
        session = self.ask("POST", "/session", {"capabilities": {"alwaysMatch": wanted}})
        self.base += f"/session/{session['sessionId']}"

    def ask(self, method, path, body=None):
        """Returns the value of an answer."""
        data = None if body is None else json.dumps(body).encode()
        headers = {"Content-Type": "application/json"}
        request = urllib.request.Request(self.base + path, data, headers, method=method)
        with OPENER.open(request, timeout=60) as answer:
            return json.load(answer)["value"]

    def open(self, url):
        """Loads a page."""
        self.ask("POST", "/url", {"url": url})

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

    def element(self, selector):
        """Returns the id of an element."""
        found = self.ask("POST", "/element", {"using": "css selector", "value": selector})
        return found[ELEMENT]

    def click(self, selector):
        """Clicks on an element, as a user does."""
        self.ask("POST", f"/element/{self.element(selector)}/click", {})

    def pointer(self, selector, *moves):
        """Moves the pointer to parts of an element's width, with other actions between them."""
        box = self.script(
            f"const it = document.querySelector({json.dumps(selector)});"
            "it.scrollIntoView({block: 'center'}); const box = it.getBoundingClientRect();"
            "return [box.left, box.top, box.width, box.height]")
        left, top, width, height = box
        actions = []
        for move in moves:
            if isinstance(move, str):
                actions.append({"type": move, "button": 0})
            else:
                x, y = left + move * width, top + height / 2
                actions.append({"type": "pointerMove", "x": round(x), "y": round(y), "duration": 60})
        source = {"type": "pointer", "id": "mouse", "actions": actions}
        self.ask("POST", "/actions", {"actions": [source]})

    def command(self, name, **params):
        """Sends a command of Chromium's own protocol."""
        return self.ask("POST", "/goog/cdp/execute", {"cmd": name, "params": params})

    def width(self, pixels, height=1700):
        """Makes the page this wide, as on a telephone, and high."""
        self.command("Emulation.setDeviceMetricsOverride",
                     width=pixels, height=height, deviceScaleFactor=1, mobile=False)

    def scheme(self, name):
        """Asks for light or dark colours."""
        features = [{"name": "prefers-color-scheme", "value": name}]
        self.command("Emulation.setEmulatedMedia", features=features)

    def errors(self):
        """Returns what the page's console has said since the last call."""
        said = self.ask("POST", "/se/log", {"type": "browser"})
        return [it for it in said if "favicon" not in it["message"]]

    def requests(self):
        """Returns the addresses of all requests since the last call."""
        said = self.ask("POST", "/se/log", {"type": "performance"})
        said = [json.loads(it["message"])["message"] for it in said]
        sent = [it for it in said if it["method"] == "Network.requestWillBeSent"]
        return [it["params"]["request"]["url"] for it in sent]

    def picture(self, path):
        """Writes a picture of what is in the window."""
        with open(path, "wb") as file:
            file.write(base64.b64decode(self.ask("GET", "/screenshot")))

    def check_width(self, pixels):
        """Checks that the page is not wider than a window of this width."""
        self.width(pixels)
        fits = ("const wide = document.documentElement.scrollWidth;"
                "return innerWidth === %d && wide <= innerWidth" % pixels)
        self.until(f"a page of {pixels} px", fits)

    def check_contrast(self, scheme, least):
        """Checks that each of at least so many texts can be read in these colours."""
        self.scheme(scheme)
        self.until(scheme, f"return matchMedia('(prefers-color-scheme: {scheme})').matches")
        found = self.script(PALE_TEXTS)
        assert found["count"] >= least, found
        assert not found["pale"], f"{scheme}: {found['pale']}"


@contextlib.contextmanager
def chromium():
    """Yields a browser, by a chromedriver on a free port, and ends both."""
    with tempfile.TemporaryDirectory() as folder:
        driver = subprocess.Popen(["chromedriver", "--port=0"], stdout=subprocess.PIPE, text=True)
        try:
            ready = next(line for line in driver.stdout if "started successfully on port" in line)
            browser = Browser(int(ready.rstrip(".\n").split()[-1]), folder)
            try:
                yield browser
            finally:
                browser.ask("DELETE", "")
        finally:
            driver.terminate()
            driver.wait()
