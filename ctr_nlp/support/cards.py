"""What a notebook shows of a value: lines in two views as a small SVG picture, and a table of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.exceptions import escaped
from ctr_nlp.typing import Array

VIEWS = ((0, "x"), (1, "y"))
"""What goes across in each view; z goes up."""
HEIGHT, MARGIN, LEAST = 240.0, 14.0, 60.0
"""Height of a view, margin around it, and its least width, pixels."""


class Line(NamedTuple):
    """A line through points (n, 3) in mm."""

    points: Array
    colour: str
    width: float = 1.5
    dash: str = ""


def card(title: str, lines: Sequence[Line], rows: Sequence[tuple[str, Any]]) -> str:
    """HTML of a title, the picture of lines, those that are not known left out, and rows of name and value."""
    cells = "".join(
        f"<tr><td>{escape(escaped(name))}</td><td>{escape(escaped(str(value)))}</td></tr>" for name, value in rows
    )
    return (
        f"<div><b>{escape(escaped(title))}</b><div style='display:flex;gap:1em'>{picture(lines)}"
        f"<table>{cells}</table></div></div>"
    )


def picture(lines: Sequence[Line]) -> str:
    """An SVG of lines to scale, over x and over y, z upwards; empty where no line is known."""
    known = [line for line in lines if len(line.points) and np.isfinite(line.points).all()]
    if not known:
        return ""
    every = np.concatenate([line.points for line in known])
    low, high = every.min(axis=0), every.max(axis=0)
    scale, left, drawn = HEIGHT / max(float((high - low).max()), 1e-9), MARGIN, []
    for across, name in VIEWS:
        width = max(scale * float(high[across] - low[across]), LEAST)
        middle, centre = (low[across] + high[across]) / 2, left + width / 2
        for line in known:
            x = centre + scale * (line.points[:, across] - middle)
            y = MARGIN + scale * (high[2] - line.points[:, 2])
            path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
            look = f"fill='none' stroke='{line.colour}' stroke-width='{line.width}' stroke-dasharray='{line.dash}'"
            drawn.append(f"<polyline points='{path}' {look}/>")
        drawn.append(f"<text x='{left:.0f}' y='{HEIGHT + 2 * MARGIN:.0f}' font-size='10'>z over {name}</text>")
        left += width + MARGIN
    size = f"width='{left:.0f}' height='{HEIGHT + 2.5 * MARGIN:.0f}'"
    return f"<svg xmlns='http://www.w3.org/2000/svg' {size}>{''.join(drawn)}</svg>"
