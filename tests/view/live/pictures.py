"""Picture of the live page for the documentation: the robot follows a target whose tip is pulled aside.

`PYTHONPATH=tests python tests/view/live/pictures.py FOLDER` writes live.png.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from browser import SOFTWARE, launcher
from common import named_problem

from ctr_nlp.view.live import Live
from ctr_nlp.view.live.steered.goal import HANDLES

SIZE = {"width": 1440, "height": 900}
PULLED_MM = (4.0, 0.0, -2.0)
"""Displacement of the target's tip."""
COMPILED_S = 600.0
"""Time within which the program of the elastic model is compiled."""


def picture(path: Path) -> None:
    """Write the picture of the page of the problem bronchus to a file."""
    live = Live(named_problem("bronchus", 60), port=0)
    with launcher() as launch:
        page = launch(SOFTWARE).new_page(viewport=SIZE)
        page.set_default_timeout(120_000)
        page.goto(live.url)
        page.get_by_text("shape error e2").wait_for()
        for close in page.locator(".mantine-Notification-closeButton").all():  # software rendering is told of
            close.click()
        end = time.monotonic() + COMPILED_S
        while live._session.pending_drive is not None and time.monotonic() < end:
            time.sleep(0.5)
        live.ask(lambda session: session.advance(0.8))
        live.ask(lambda session: session.pull(HANDLES - 1, session.goal.handles[-1] + PULLED_MM))
        page.wait_for_timeout(8000)
        path.write_bytes(page.screenshot())
    live.stop()


if __name__ == "__main__":
    picture(Path(sys.argv[1]) / "live.png")
