"""Pictures of a plan's page at the widths of a phone, a tablet and a desk, for the documentation.

`python tests/report/pictures.py PLAN.npz FOLDER` writes report-390.png, report-768.png and report-1440.png; the folder
`tests` has to be on Python's path.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path

from browser import SOFTWARE, launcher, opened
from PIL import Image

from ctr_nlp import Plan
from ctr_nlp.report import page

SIZES = ((390, 844), (768, 1024), (1440, 900))
MOMENT, COLOURS = 0.9, 96


def pictures(plan: Plan, name: str, folder: Path) -> list[Path]:
    """Write a picture of the page at each width, in few colours, at nine tenths of the motion; the files' paths."""
    written = []
    with tempfile.TemporaryDirectory() as place, launcher() as launch:
        file, browser = Path(place) / "report.html", launch(SOFTWARE)
        file.write_text(page([plan], [name]), encoding="utf-8")
        for width, height in SIZES:
            with opened(browser, file, width, height) as view:
                view.set_default_timeout(120_000)
                view.wait_for_function("scenes.every((scene) => scene)")
                view.evaluate(f"seek({MOMENT})")
                if width < SIZES[-1][0]:
                    view.evaluate("document.querySelector('.remarks').scrollIntoView(); scrollBy(0, -250)")
                view.evaluate("() => new Promise((done) => setTimeout(done, 2000))")
                image = Image.open(io.BytesIO(view.screenshot())).convert("RGB").quantize(COLOURS, dither=0)
            written.append(folder / f"report-{width}.png")
            image.save(written[-1], optimize=True)
    return written


if __name__ == "__main__":
    for path in pictures(Plan.load(sys.argv[1]), sys.argv[1], Path(sys.argv[2])):
        print(path, f"{path.stat().st_size / 1e3:.0f} kB")
