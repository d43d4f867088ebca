"""Walls around a robot: what it must stay inside of, and what it must keep away from.

A wall is a lumen around a path (lumen.py) or bodies whose surfaces are distance fields (distance_field.py).
Programs, verdicts and contact see the nearest of them at every point of the robot, and all of them in the same
form: a path and a radius near the point (LumenProjection).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ctr_nlp.exceptions import ProblemError
from ctr_nlp.paths.distance_field import DistanceField
from ctr_nlp.paths.lumen import Lumen, LumenProjection
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_checks import check_instance, number
from ctr_nlp.support.value_objects import Value
from ctr_nlp.typing import Array, Index

MAX_MARGIN_MM = 100.0
"""Largest margin of a body, mm."""


class WallGeometry(Protocol):
    """Protocol of walls as programs and verdicts use them; Lumen and Walls have it."""

    def project(self, points: Array) -> LumenProjection:
        """Describe the wall near points (.., 3), mm, as a path with a radius."""


@packable("wall-body")
@dataclass(frozen=True, eq=False)
class Body(Value):
    """A surface that a robot stays inside of, or keeps away from.

    Attributes
    ----------
    name : str
        Name under which its contact is reported.
    field : DistanceField
        Signed distance, positive inside the body, mm.
    keep_out : bool
        Whether the robot keeps outside of the body; otherwise it stays inside.
    margin : float
        Distance that the robot keeps from the surface in addition to the clearance of the settings, mm.

    Raises
    ------
    ProblemError
        A value is not what it must be.
    """

    name: str
    field: DistanceField
    keep_out: bool = False
    margin: float = 0.0

    def __post_init__(self) -> None:
        check_instance(ProblemError, "name of a wall", self.name, str)
        check_instance(ProblemError, f"field of the wall {self.name!r}", self.field, DistanceField)
        what, allowed = f"margin of the wall {self.name!r}", f"lie in [0, {MAX_MARGIN_MM:g}] mm"
        number(ProblemError, what, self.margin, lambda x: 0 <= x <= MAX_MARGIN_MM, allowed, " mm")

    @property
    def sign(self) -> float:
        """1 where the robot stays inside, -1 where it keeps out."""
        return -1.0 if self.keep_out else 1.0

    def apply_transform(self, transform: Array) -> Body:
        """Return the body moved by a rigid transform (4, 4)."""
        return replace(self, field=self.field.apply_transform(transform))

    def project(self, points: Array) -> LumenProjection:
        """Describe the surface near points (.., 3), mm, as a path with a radius; the margin is taken off."""
        return self.field.project(points, self.sign, self.margin)


class Walls:
    """A lumen and bodies, of which the nearest counts at every point.

    Parameters
    ----------
    lumen : Lumen or None
        The lumen around a path, where that is a wall.
    bodies : tuple of Body
        Other walls.
    """

    def __init__(self, lumen: Lumen | None, bodies: tuple[Body, ...]) -> None:
        if lumen is None and not bodies:
            raise ProblemError("walls are empty; give a lumen or a body")
        self.lumen = lumen
        self.bodies = bodies

    def project(self, points: Array) -> LumenProjection:
        """Describe the nearest wall near points (.., 3), mm, as a path with a radius."""
        walls: list[WallGeometry] = [*([] if self.lumen is None else [self.lumen]), *self.bodies]
        each = [wall.project(points) for wall in walls]
        nearest = np.argmin([near.radius - near.distance for near in each], axis=0)
        stacked = (np.stack(parts) for parts in zip(*each, strict=True))
        return LumenProjection(*(_pick(parts, nearest) for parts in stacked))


def _pick(parts: Array, nearest: Index) -> Array:
    """Return parts (walls, .., *rest) at the nearest (..,) wall of each point."""
    index = nearest.reshape(nearest.shape + (1,) * (parts.ndim - 1 - nearest.ndim))
    return np.asarray(np.take_along_axis(parts, index[None], axis=0)[0])


def nearest_of(lumen: Lumen | None, bodies: tuple[Body, ...]) -> WallGeometry | None:
    """Return the wall of a lumen and bodies; None where there is none.

    lumen: around the path. It is no wall where the robot stays inside of one of the bodies: airways are not round,
    and the body is what they are.
    """
    if not bodies:
        return lumen
    return Walls(lumen if all(body.keep_out for body in bodies) else None, bodies)
