"""HTML that a notebook shows for a value: lines in two views as a small SVG picture, and a table of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import escape_control_characters
from ctr_nlp.typing import Array

VIEWS = ((0, "x"), (1, "y"))
"""Coordinate on the horizontal axis of each view, and its name; z is vertical."""
CARD_VIEW_HEIGHT_PX, CARD_VIEW_MARGIN_PX, MIN_CARD_VIEW_WIDTH_PX = 240.0, 14.0, 60.0
"""Height of a view, margin around it, and its least width, pixels."""


class CardLine(NamedTuple):
    """A line through points (n, 3) in mm."""

    points: Array
    colour: str
    width: float = 1.5
    dash: str = ""


def notebook_card_html(title: str, lines: Sequence[CardLine], rows: Sequence[tuple[str, Any]]) -> str:
    """Return HTML with a title, a picture of lines and a table.

    lines: drawn where all their points are finite. rows: name and value of each line of the table.
    """
    cells = "".join(
        f"<tr><td>{escape(escape_control_characters(name))}</td><td>{escape(escape_control_characters(str(value)))}</td></tr>"
        for name, value in rows
    )
    return (
        f"<div><b>{escape(escape_control_characters(title))}</b><div "
        f"style='display:flex;gap:1em'>{lines_svg(lines)}"
        f"<table>{cells}</table></div></div>"
    )


def lines_svg(lines: Sequence[CardLine]) -> str:
    """Return an SVG picture of lines to scale, z over x and z over y; empty where no line has finite points."""
    known = [line for line in lines if len(line.points) and np.isfinite(line.points).all()]
    if not known:
        return ""
    every = np.concatenate([line.points for line in known])
    low = every.min(axis=0)
    high = every.max(axis=0)
    # One scale for both views, from the largest extent, so that lengths can be compared.
    scale = CARD_VIEW_HEIGHT_PX / max(float((high - low).max()), 1e-9)
    left = CARD_VIEW_MARGIN_PX
    drawn = []
    for across, name in VIEWS:
        width = max(scale * float(high[across] - low[across]), MIN_CARD_VIEW_WIDTH_PX)
        middle = (low[across] + high[across]) / 2
        centre = left + width / 2
        for line in known:
            x = centre + scale * (line.points[:, across] - middle)
            # SVG's y axis points down.
            y = CARD_VIEW_MARGIN_PX + scale * (high[2] - line.points[:, 2])
            path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
            look = f"fill='none' stroke='{line.colour}' stroke-width='{line.width}' stroke-dasharray='{line.dash}'"
            drawn.append(f"<polyline points='{path}' {look}/>")
        drawn.append(
            f"<text x='{left:.0f}' y='{CARD_VIEW_HEIGHT_PX + 2 * CARD_VIEW_MARGIN_PX:.0f}' font-size='10'>z "
            f"over {name}</text>"
        )
        left += width + CARD_VIEW_MARGIN_PX
    size = f"width='{left:.0f}' height='{CARD_VIEW_HEIGHT_PX + 2.5 * CARD_VIEW_MARGIN_PX:.0f}'"
    return f"<svg xmlns='http://www.w3.org/2000/svg' {size}>{''.join(drawn)}</svg>"
