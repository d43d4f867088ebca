"""A real headless Chromium, and what its screenshots show."""

import io
import os
import shutil
from contextlib import contextmanager

import numpy as np
import pytest
from matplotlib.colors import rgb_to_hsv
from matplotlib.image import imread

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
NO_GRAPHICS = ("--disable-gpu", "--disable-3d-apis", "--no-sandbox")


@contextmanager
def launcher():
    """A function that starts a browser with the flags given; tests are skipped where there is none."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    found = os.environ.get("CTR_NLP_CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is on the path, and CTR_NLP_CHROMIUM names none")
    with sync_api.sync_playwright() as playwright:
        yield lambda flags: playwright.chromium.launch(executable_path=found, args=list(flags))


@contextmanager
def opened(browser, file, width, height=900, **options):
    """A page without a network; it must ask for nothing and complain of nothing. options: those of a context."""
    context = browser.new_context(viewport={"width": width, "height": height}, offline=True, **options)
    page, trouble = context.new_page(), []
    page.on(
        "console", lambda message: trouble.append(message.text) if message.type in ("error", "warning") else None
    )
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on("request", lambda request: trouble.append(request.url) if request.url.startswith("http") else None)
    page.goto(file.as_uri())
    yield page
    assert trouble == []
    context.close()


def pixels(shot):
    """A screenshot (rows, columns, 3) in [0, 1]."""
    return imread(io.BytesIO(shot))[..., :3]


def changed(image, other):
    """Part of the pixels that differ clearly; a row or column more or less is rounding."""
    rows, columns = np.minimum(image.shape, other.shape)[:2]
    return float((np.abs(image[:rows, :columns] - other[:rows, :columns]).max(axis=-1) > 0.1).mean())


def share_of_hue(image, colour, tolerance=0.04):
    """Part of an image's pixels that have a colour's hue, whatever light falls upon it."""
    wanted = rgb_to_hsv(colour)[0]
    low, high = image.min(axis=-1), image.max(axis=-1)
    strong = (high - low) > 0.35 * np.maximum(high, 1e-6)
    away = np.abs((rgb_to_hsv(image)[strong, 0] - wanted + 0.5) % 1.0 - 0.5)
    return float((away < tolerance).sum() / strong.size)
