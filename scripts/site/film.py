"""Film the scene of a report: `python scripts/site/film.py REPORT.html FILM.gif`.

Needs Chromium and playwright, which the extra `dev` brings.
"""

from __future__ import annotations

import io
import shutil
import sys
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

WIDTH, HEIGHT = 460, 900
"""Size of the window, pixels."""
FRAME_COUNT, FRAME_MS, LAST_FRAME_MS = 26, 160, 2000
"""Pictures of the film, and how long each and the last are shown, ms."""
FILM_WIDTH, COLOURS = 430, 255
"""Width of the film, pixels, and its colours."""
LOAD_MS, DRAW_MS = 9000, 500
"""Time for the scene to be drawn at first, and after each step, ms: software rendering is slow."""
GRAPHICS = "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"
"""Flags of Chromium for drawing without a graphics card."""


def film(report: Path, out: Path) -> None:
    """Write the scene of a report page as a GIF, from the first frame to the last."""
    pictures = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=list(GRAPHICS))
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto(report.resolve().as_uri())
        page.wait_for_timeout(LOAD_MS)
        slider = page.locator("#frame")
        last = int(slider.get_attribute("max") or 1)
        scene = page.locator(".scene").first
        for k in range(FRAME_COUNT):
            frame = 1 + round(k * (last - 1) / (FRAME_COUNT - 1))
            slider.evaluate(
                "(slider, frame) => { slider.value = frame; slider.dispatchEvent(new Event('input')); }", frame
            )
            page.wait_for_timeout(DRAW_MS)
            pictures.append(Image.open(io.BytesIO(scene.screenshot())).convert("RGB"))
        browser.close()
    height = round(pictures[0].height * FILM_WIDTH / pictures[0].width)
    small = [each.resize((FILM_WIDTH, height), Image.Resampling.LANCZOS) for each in pictures]
    # One palette for all, of the last picture, in which everything is seen: colours must not flicker.
    palette = small[-1].quantize(COLOURS, method=Image.Quantize.FASTOCTREE)
    drawn = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in small]
    times = [FRAME_MS] * (FRAME_COUNT - 1) + [LAST_FRAME_MS]
    drawn[0].save(out, save_all=True, append_images=drawn[1:], duration=times, loop=0, optimize=True)


if __name__ == "__main__":
    film(Path(sys.argv[1]), Path(sys.argv[2]))
