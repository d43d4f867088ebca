"""How fast live steering is in a real browser: pictures a second while the robot moves, and from hand to picture.

python scripts/studies/live_pace.py [PROBLEM] [--model NAME] [--size WxH ...] [--seconds S] [--flag FLAG ...]

Needs playwright (`pip install -e ".[dev]"`) and a Chromium on the path. Run it while nothing else is at work.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from playwright.sync_api import Page, sync_playwright

from ctr_nlp.codegen.cache import COMPILE_VARIABLE
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.paths.named_problems import named_problem
from ctr_nlp.support.tables import markdown
from ctr_nlp.view.live import Live

BROWSERS = "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"
SOFTWARE = "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"
"""Pictures are drawn by the processor, as on a machine without a graphics card."""
APART = 4.0
"""ms between calls that draw, from which on they belong to another picture."""
HANDS, REST = 20, 1500.0
"""Times that a key moves the target, and ms after each, in which the robot comes to rest."""
WATCHED = """
window.drawn = []; window.moved = []; window.pressed = [];
const known = new Map(), gl = WebGL2RenderingContext.prototype;
const wrap = (name, before) => {
  const own = gl[name];
  gl[name] = function (...given) { before(given); return own.apply(this, given); };
};
for (const name of ['drawElements', 'drawArrays', 'drawElementsInstanced', 'drawArraysInstanced'])
  wrap(name, () => window.drawn.push(performance.now()));
for (const name of ['bufferData', 'bufferSubData', 'texSubImage2D', 'texImage2D'])
  wrap(name, given => {
    const data = given.find(each => each instanceof Float32Array);
    if (!data) return;
    const told = data.join(), place = name + data.length;
    if (known.get(place) !== told) requestAnimationFrame(() => window.moved.push(performance.now()));
    known.set(place, told);
  });
addEventListener('keydown', event => window.pressed.push(event.timeStamp), true);
"""
"""Notes when something is drawn, when a picture of another shape has been, and when a key is pressed."""


def main() -> None:
    """Measure each size of the window, and print a table."""
    parser = argparse.ArgumentParser(description="How fast live steering is in a real browser.")
    parser.add_argument("problem", metavar="PROBLEM", nargs="?", default="arc", help="a named one (default arc)")
    parser.add_argument("--model", choices=sorted(KINEMATIC_MODELS), default="elastic", help="(default elastic)")
    what = "of the window, pixels (default 900x640 and 600x450)"
    parser.add_argument(
        "--size", metavar="WxH", type=_size, nargs="+", default=[(900, 640), (600, 450)], help=what
    )
    parser.add_argument("--seconds", metavar="S", type=float, default=30.0, help="of motion (default 30)")
    what = "further ones for Chromium, without the two dashes, such as webgl-antialiasing-mode=none"
    parser.add_argument("--flag", metavar="FLAG", nargs="*", default=[], help=what)
    asked = parser.parse_args()
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        parser.error(f"there is no browser: none of {', '.join(BROWSERS)} is on the path")
    flags = [f"--{flag}" for flag in asked.flag]
    os.environ[COMPILE_VARIABLE] = "now"
    live = Live(named_problem(asked.problem, 100), port=0, model=asked.model)
    try:
        rows = [_measured(live, browser, size, asked.seconds, flags) for size in asked.size]
    finally:
        live.stop()
    told = "window", "pictures a second", "ms a picture", "server, cores", "hand to picture, ms", "of 95 %, ms"
    print(markdown(told, rows))


def _size(text: str) -> tuple[int, int]:
    """Width and height of a window."""
    found = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", text)
    if found is None:
        raise argparse.ArgumentTypeError(f"size is {text!r}; it must be WIDTHxHEIGHT in pixels, such as 900x640")
    return int(found[1]), int(found[2])


def _measured(live: Live, program: str, size: tuple[int, int], seconds: float, flags: Sequence[str]) -> list[str]:
    """A row for a window of a size, of a browser's program."""
    wide, high = size
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=[*SOFTWARE, *flags])
        page = browser.new_page(viewport={"width": wide, "height": high})
        page.set_default_timeout(60_000)
        page.add_init_script(WATCHED)
        page.goto(live.url)
        page.get_by_text("shape error e2").wait_for()
        for close in page.locator(".mantine-Notification-closeButton").all():  # software rendering is told of
            close.click()
        waited = _hands(page)
        pictures, busy = _motion(page, live, seconds)
        browser.close()
    between = np.diff(pictures)
    numbers = 1e3 / between.mean(), np.median(between), busy, np.median(waited), np.percentile(waited, 95)
    return [f"{wide} x {high}", *(f"{number:.3g}" for number in numbers)]


def _motion(page: Page, live: Live, seconds: float) -> tuple[Any, float]:
    """When pictures were drawn while the robot follows its path, ms, and what part of a core the server takes."""
    live.ask(lambda session: session.goal.advance(0.0))
    live.play(True)
    page.wait_for_timeout(2000)
    page.evaluate("window.drawn.length = 0")
    begin, taken = time.perf_counter(), time.process_time()
    page.wait_for_timeout(1e3 * seconds)
    busy = (time.process_time() - taken) / (time.perf_counter() - begin)
    drawn = np.array(page.evaluate("window.drawn"))
    live.play(False)
    return drawn[np.append(True, np.diff(drawn) > APART)], busy


def _hands(page: Page) -> Any:
    """From every key that moves the target to the picture of the robot that follows it, ms."""
    slider = page.get_by_role("slider").first  # progress on the path
    slider.focus()
    waited = []
    for k in range(HANDS):
        page.wait_for_timeout(REST)
        page.evaluate("window.moved.length = window.pressed.length = 0")
        slider.press("ArrowRight" if k % 2 else "ArrowLeft")
        page.wait_for_timeout(REST)
        pressed, moved = page.evaluate("[window.pressed, window.moved]")
        waited.append(min(each for each in moved if each >= pressed[0]) - pressed[0])
    return np.array(waited)


if __name__ == "__main__":
    main()
