"""What Grbl and grblHAL say, one line at a time (github.com/gnea/grbl/wiki/Grbl-v1.1-Interface)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ctr_nlp.typing import Array


class Reply(NamedTuple):
    """kind: ok, error, alarm, banner, message, setting, report or unreadable; number: of an error or alarm."""

    kind: str
    text: str
    number: int = 0


@dataclass(frozen=True)
class Report:
    """A status report. position (m,): MPos, in the order of the controller's axes, mm and deg.

    state: Idle, Run, Hold, Jog, Alarm, Home, Check, ...; stopped: whether a Hold has come to rest. line: number
    of the line that is being played, 0 where that is not told. free: empty blocks of the planner; override: of the
    feed, in %; None where that is not told, as an override is for many reports after the one that told it.
    """

    state: str
    stopped: bool
    position: Array
    line: int
    free: int | None
    override: float | None


_PATTERNS = (
    ("ok", re.compile(r"ok")),
    ("error", re.compile(r"error:(\d+)")),
    ("alarm", re.compile(r"ALARM:(\d+)")),
    ("banner", re.compile(r"Grbl(HAL)? \d.*", re.IGNORECASE)),
    ("message", re.compile(r"\[[A-Z0-9. ]+:?.*\]|")),
    ("setting", re.compile(r"\$\d+=.*")),
    ("report", re.compile(r"<[A-Z][a-z]+(:\d+)?\|.*>")),
)

REPORT = re.compile(r"<(?P<state>[A-Z][a-z]+)(:(?P<part>\d+))?\|(?P<fields>[^<>]*)>")
NUMBERS = re.compile(r"-?\d+\.\d+(,-?\d+\.\d+)*", re.ASCII)
WHOLE = re.compile(r"\d+", re.ASCII)
"""Noise has digits of other kinds, as ¹, which are no numbers."""


def reply_of(text: str) -> Reply:
    """The reply that a line is."""
    for kind, pattern in _PATTERNS:
        found = pattern.fullmatch(text)
        if found:
            return Reply(kind, text, int(found[1]) if kind in ("error", "alarm") else 0)
    return Reply("unreadable", text)


def report_of(text: str, axes: int) -> Report | None:
    """The report that a line of this many axes is, or None where it is damaged."""
    found = REPORT.fullmatch(text)
    if not found:
        return None
    fields = dict(field.partition(":")[::2] for field in found["fields"].split("|"))
    position = _numbers(fields.get("MPos"), axes)
    line, free = fields.get("Ln", "0"), fields.get("Bf", "").partition(",")[0]
    if position is None or not WHOLE.fullmatch(line):
        return None
    stopped = found["state"] == "Hold" and found["part"] == "0"
    override = fields.get("Ov", "").partition(",")[0]
    return Report(
        found["state"],
        stopped,
        position,
        int(line),
        int(free) if WHOLE.fullmatch(free) else None,
        float(override) if WHOLE.fullmatch(override) else None,
    )


def _numbers(text: str | None, count: int) -> Array | None:
    if text is None or not NUMBERS.fullmatch(text):
        return None
    values = np.array([float(value) for value in text.split(",")])
    return values if len(values) == count else None
