"""Uses the plots of a report in Chromium: report.py FILE MOMENT_S SINCE_BEGIN_OF_TRACE_NS.

With the environment variable TANDEM_PICTURES=FOLDER it keeps pictures there.
"""

import os
import pathlib
import re
import sys

from chromium import chromium

FILE, MOMENT_S, IN_TRACE_NS = pathlib.Path(sys.argv[1]), float(sys.argv[2]), int(sys.argv[3])
RANGES = """
return plots.all().map(({ place, spec, u }) => ({
  title: spec.title, scale: spec.x.scale, whole: spec.x.range, from: u.scales.x.min, to: u.scales.x.max,
  legend: place.querySelector(".u-legend").innerText, canvas: u.width,
  isEmpty: u.data[0].length === 0, isOfStates: spec.spans.length > 0,
}));
"""


def over_time(browser):
    """Returns the plots over time, and checks that they show the same span."""
    plots = [it for it in browser.script(RANGES) if it["scale"] == "time"]
    spans = {(round(it["from"], 6), round(it["to"], 6)) for it in plots}
    assert len(spans) == 1 and len(plots) >= 6, plots
    return plots


def picture(browser, name):
    """Keeps a picture, if they are wanted."""
    if folder := os.environ.get("TANDEM_PICTURES"):
        browser.picture(f"{folder}/{name}.png")


def settle(browser, what, script):
    """Waits for a script, and then until uPlot has drawn."""
    browser.until(what, script)
    browser.ask("POST", "/execute/async", {"script": "requestAnimationFrame(arguments[0])", "args": []})


def check_zoom(browser):
    """A drag over a plot shows that part in all plots over time, a double click shows all again."""
    whole = over_time(browser)[0]
    assert [whole["from"], whole["to"]] == whole["whole"], whole
    length = whole["to"] - whole["from"]
    browser.script("document.querySelectorAll('.plot .u-over')[1].id = 'dragged'")
    before = {it["title"]: it["from"] for it in browser.script(RANGES)}
    browser.pointer("#dragged", 0.30, "pointerDown", 0.45, 0.60, "pointerUp")
    settle(browser, "a zoom", "const [it] = plots.all(); return it.u.scales.x.min !== it.spec.x.range[0]")
    zoomed = over_time(browser)[0]
    for name, part in [("from", 0.30), ("to", 0.60)]:
        shown = (zoomed[name] - whole["from"]) / length
        # The pointer is on whole pixels.
        assert abs(shown - part) < 0.004, (name, shown)
    others = [it for it in browser.script(RANGES) if it["scale"] == "nines"]
    assert others and all(it["from"] == before[it["title"]] for it in others), others
    picture(browser, "zoomed")
    browser.pointer("#dragged", 0.5, "pointerDown", "pointerUp", "pointerDown", "pointerUp")
    settle(browser, "the whole run", "const [it] = plots.all(); return it.u.scales.x.min === it.spec.x.range[0]")
    over_time(browser)


def check_values(browser):
    """The pointer shows values: in the plot below it, and at the same time in the others."""
    browser.pointer("#dragged", 0.25)
    legend = "plots.all()[1].place.querySelector('.u-legend').innerText"
    settle(browser, "a value", f"return /at\\s*:?\\s*\\d+\\.\\d{{4}} s/.test({legend})")
    # A run without a grandmaster has nothing to draw in some plots.
    plots = [it for it in over_time(browser) if not it["isEmpty"]]
    at = sorted(float(re.search(r"\d+\.\d{4}", it["legend"])[0]) for it in plots)
    # Each plot names its nearest sample. The slowest ones are 100 ms apart.
    assert at[-1] - at[0] < 0.15, at
    states = ("master", "standby", "–")
    assert any(it in plots[0]["legend"] for it in states[:2]), plots[0]["legend"]
    for plot in [it for it in plots if not it["isOfStates"]]:
        assert any(letter.isdigit() for letter in plot["legend"].split(" s", 1)[1]), plot


def check_moment(browser):
    """A click on an event moves all plots over time, and names the time in the trace."""
    shown = f"[data-at='{MOMENT_S:.6f}']"
    browser.script("document.body.style.scrollBehavior = 'auto'")
    browser.script(f"document.querySelector(\"{shown}\").scrollIntoView({{block: 'center'}})")
    browser.click(shown)
    settle(browser, "the moment", "return document.querySelector('#moment .at b') !== null")
    for plot in over_time(browser):
        middle, width = (plot["from"] + plot["to"]) / 2, plot["to"] - plot["from"]
        assert abs(middle - MOMENT_S) < 1e-6 and 0 < width <= 2.0, plot
    us = IN_TRACE_NS // 1_000
    minutes, seconds = us // 60_000_000, us // 1_000_000 % 60
    wanted = f"00:{minutes:02}:{seconds:02}.{us // 1_000 % 1_000:03} {us % 1_000:03}"
    told = browser.script("return document.querySelector('#moment .at').innerText")
    assert f"{MOMENT_S:.4f} s" in told and wanted in told, (told, wanted)
    browser.click("#moment [data-zoom='0.5']")
    narrow = over_time(browser)[0]
    assert abs((narrow["to"] - narrow["from"]) - width / 2) < 1e-6, narrow
    browser.script("scrollTo(0, 0)")
    picture(browser, "moment")


def main():
    """Checks a report."""
    url = FILE.resolve().as_uri()
    with chromium() as browser:
        # Without the requests of the page with which Chromium starts.
        browser.open("about:blank")
        browser.requests()
        browser.open(url)
        settle(browser, "plots", "return plots.all().length >= 6")
        check_zoom(browser)
        check_values(browser)
        check_moment(browser)
        browser.check_contrast("light", 200)
        browser.check_contrast("dark", 200)
        drawn = "const it = plots.all().at(-1); return [it.u.series[1].stroke(), getComputedStyle(document.body).color]"
        stroke = browser.script(drawn)
        picture(browser, "dark")
        browser.check_width(400)
        settle(browser, "narrow plots", "return plots.all().every((it) => it.u.width <= 400)")
        picture(browser, "dark-400")
        browser.scheme("light")
        settle(browser, "light", "return !matchMedia('(prefers-color-scheme: dark)').matches")
        assert browser.script(drawn) != stroke, "the plots keep the colours of a dark page"
        picture(browser, "light-400")
        asked = [it for it in browser.requests() if not it.startswith("data:")]
        assert asked == [url], asked
        assert not (errors := browser.errors()), errors


main()
