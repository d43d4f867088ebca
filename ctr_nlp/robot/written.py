"""A robot as the text of a robot file, which Robot.from_toml reads to the same robot."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import Any

from ctr_nlp.robot.robot import Robot

COMMENTS = {
    "length": "mm, the whole tube, from its carriage to its tip",
    "curved_length": "mm, the part behind the tip that is pre-curved; the rest is straight transmission",
    "curvature": "1/mm; [root, tip] of the curved part, linear between them",
    "outer_diameter": "mm",
    "inner_diameter": "mm",
}
"""What is said beside a tube's numbers."""


def toml_of(robot: Robot, head: str = "") -> str:
    """The text of a file; head: lines of comment that it begins with, without their marks."""
    plain = robot.to_dict()
    lines = [f"# {line}" for line in head.splitlines()]
    for tube in plain["tubes"]:
        lines += ["", "[[tubes]]", *_lines(tube, COMMENTS)]
    for name in ("limits", "tolerances"):
        lines += ["", f"[{name}]", *_lines(plain[name], {})]
    return "\n".join(lines) + "\n"


def _lines(table: Mapping[str, Any], comments: Mapping[str, str]) -> list[str]:
    """Of the keys that have a value: TOML has no word for none."""
    found = [(name, _value(value)) for name, value in table.items() if value is not None]
    return [f"{name} = {text}{f'  # {comments[name]}' if name in comments else ''}" for name, text in found]


def _value(value: Any) -> str:
    """A number, a string or a list of these."""
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_value, value))}]"
    if value in ("inf", "-inf"):
        return str(value)
    if isinstance(value, str):
        return json.dumps(value)
    number = float(value)
    return repr(number) if math.isfinite(number) else f"{number}"
