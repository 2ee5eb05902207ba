"""Clicks on a live page in Chromium: browser.py URL#TOKEN PICTURE."""

import pathlib
import sys
import time

sys.path.insert(0, str(pathlib.Path(__file__).parents[3] / "page/tests"))
from chromium import chromium

URL, PICTURE = sys.argv[1:]


def text_of(name):
    """Returns a script that returns the text of an element."""
    return f"document.getElementById('{name}').innerText"


def check(browser):
    """Kills the master's supply by a click, and returns when the page shows the takeover."""
    browser.open(URL)
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
    # One system alone: the page says so, in words and in the plot of the roles.
    alone = f"return /no redundancy since [0-9.]+ s: {other} drives alone/.test({text_of('head')})"
    browser.until("the lost redundancy", alone)
    spans = "plots.all().find((it) => it.place.id === 'roles').spec.spans"
    browser.until("its bar", f"return {spans}.some((it) => it.name === 'no redundancy')")
    browser.until("the road", "return document.querySelectorAll('#lane path').length > 8")
    browser.check_contrast("dark", 60)
    browser.check_contrast("light", 60)
    browser.check_width(400)
    browser.picture(PICTURE.replace(".png", "-400.png"))
    browser.width(1200)
    # So much of the time after it is in the picture.
    time.sleep(2)
    browser.picture(PICTURE)
    errors = browser.errors()
    assert not errors, errors


def main():
    """Checks a live page."""
    with chromium() as browser:
        check(browser)


main()
