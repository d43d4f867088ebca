"""All pictures of a plan as files."""

from __future__ import annotations

from pathlib import Path

from ctr_nlp.errors import OutputError
from ctr_nlp.figures.frames import by_frame
from ctr_nlp.figures.motion import configuration
from ctr_nlp.figures.overlay import shapes
from ctr_nlp.figures.violins import errors
from ctr_nlp.plan import Plan

PICTURES = {"shapes": shapes, "errors": errors, "by_frame": by_frame, "configuration": configuration}
DPI = 150


def save_all(plan: Plan, folder: str | Path) -> list[Path]:
    """Write shapes.png, errors.png, by_frame.png and configuration.png into a folder that exists.

    Returns where they lie. Raises OutputError where they cannot be written.
    """
    paths = []
    for name, picture in PICTURES.items():
        path = Path(folder) / f"{name}.png"
        try:
            picture(plan).savefig(path, dpi=DPI)
        except OSError as error:
            raise OutputError(f"{path} cannot be written: {error}") from error
        paths.append(path)
    return paths
