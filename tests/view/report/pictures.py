"""Pictures of a plan's page at the widths of a phone, a tablet and a desk, for the documentation.

`PYTHONPATH=tests python tests/view/report/pictures.py PLAN.npz FOLDER` writes report-390.png, report-768.png and
report-1440.png.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from browser import SOFTWARE, launcher, opened
from PIL import Image

from ctr_nlp import Plan
from ctr_nlp.view.report import page

PICTURE_COLOURS = 256
"""Colours of a picture: a palette makes its file small."""
SIZES = ((390, 844), (768, 1024), (1440, 900))


def pictures(plan: Plan, name: str, folder: Path) -> list[Path]:
    """Write a picture of the page at each width, as it opens; the paths of the files."""
    written = [folder / f"report-{width}.png" for width, _ in SIZES]
    with tempfile.TemporaryDirectory() as place, launcher() as launch:
        file, browser = Path(place) / "report.html", launch(SOFTWARE)
        file.write_text(page([plan], [name]), encoding="utf-8")
        for (width, height), path in zip(SIZES, written, strict=True):
            with opened(browser, file, width, height) as view:
                view.set_default_timeout(120_000)
                view.wait_for_function("scenes.every((scene) => scene)")
                view.evaluate("() => new Promise((done) => setTimeout(done, 2000))")
                shot = Image.open(io.BytesIO(view.screenshot())).convert("RGB")
                shot.quantize(PICTURE_COLOURS).save(path, optimize=True)
    return written


if __name__ == "__main__":
    for path in pictures(Plan.load(sys.argv[1]), sys.argv[1], Path(sys.argv[2])):
        print(path, f"{path.stat().st_size / 1e3:.0f} kB")
