"""Moves of a person in live steering, so that the last one can be undone."""

from __future__ import annotations

import time
from typing import NamedTuple

from ctr_nlp.typing import Array

ONE_MOVE_S = 1.0
"""Changes of one control that follow each other within this time are one move: a drag is many changes."""
MAX_REMEMBERED_MOVES = 100
"""Number of moves that can be undone."""


class SteeringState(NamedTuple):
    """State of steering: progress of the goal, displacement of its handles (HANDLES, 3) mm, method, and hand.

    hand: configuration (2d + 2,) to which sliders move the robot.
    """

    progress: float
    displacement: Array
    method: str
    hand: Array


class MoveHistory:
    """States before each move, the last one last."""

    def __init__(self) -> None:
        self._before = list[SteeringState]()
        self._control = ""
        self._changed = 0.0

    def __len__(self) -> int:
        return len(self._before)

    def note(self, control: str, before: SteeringState) -> None:
        """Remember the state `before` a control is used; not again while the same control goes on changing."""
        now = time.monotonic()
        if control != self._control or now - self._changed > ONE_MOVE_S:
            self._before = [*self._before[1 - MAX_REMEMBERED_MOVES :], before]
        self._control = control
        self._changed = now

    def pop(self) -> SteeringState | None:
        """Return the state before the last move, and forget that move; None where there is none."""
        self._control = ""
        return self._before.pop() if self._before else None
