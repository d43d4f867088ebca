"""Walls around a robot: what it must stay inside of, and what it must keep away from.

A wall is a lumen around a path (lumen.py) or bodies whose surfaces are distance fields (distance_field.py).
Programs, verdicts and contact see the nearest of them at every point of the robot, and all of them in the same
form: a path and a radius near the point (LumenProjection).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import ProblemError
from ctr_nlp.paths.distance_field import DistanceField
from ctr_nlp.paths.lumen import Lumen, LumenProjection
from ctr_nlp.paths.surface import Surface
from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_checks import check_instance, number
from ctr_nlp.support.value_objects import Value
from ctr_nlp.typing import Array, Index

MAX_MARGIN_MM = 100.0
"""Largest margin of a body, mm."""
LUMEN_NAME = "lumen"
"""Name of the lumen around the path among other walls."""


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
    surface : Surface or None
        The triangles that the field was made from. Verdicts measure at them; without them, in the field, which
        rounds off edges.

    Raises
    ------
    ProblemError
        A value is not what it must be.

    Examples
    --------
    >>> from ctr_nlp.anatomy.distance_fields import field_of_surface
    >>> from ctr_nlp.paths.surface import Surface
    >>> tetrahedron = Surface(
    ...     [[0, 0, 0], [9, 0, 0], [0, 9, 0], [0, 0, 9]], [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    ... )
    >>> body = Body("vessel", field_of_surface(tetrahedron), keep_out=True, margin=2.0, surface=tetrahedron)
    >>> body.room(np.array([[3.0, 3.0, -5.0]])).tolist()
    [3.0]
    """

    name: str
    field: DistanceField
    keep_out: bool = False
    margin: float = 0.0
    surface: Surface | None = None

    def __post_init__(self) -> None:
        check_instance(ProblemError, "name of a wall", self.name, str)
        check_instance(ProblemError, f"field of the wall {self.name!r}", self.field, DistanceField)
        what, allowed = f"margin of the wall {self.name!r}", f"lie in [0, {MAX_MARGIN_MM:g}] mm"
        number(ProblemError, what, self.margin, lambda x: 0 <= x <= MAX_MARGIN_MM, allowed, " mm")
        if self.surface is not None:
            check_instance(ProblemError, f"surface of the wall {self.name!r}", self.surface, Surface)

    @property
    def sign(self) -> float:
        """1 where the robot stays inside, -1 where it keeps out."""
        return -1.0 if self.keep_out else 1.0

    def apply_transform(self, transform: Array) -> Body:
        """Return the body moved by a rigid transform.

        Parameters
        ----------
        transform : ndarray
            Homogeneous matrix (4, 4), translation in mm.

        Returns
        -------
        Body
            The moved body; its name and margin stay.
        """
        surface = None if self.surface is None else self.surface.apply_transform(transform)
        return replace(self, field=self.field.apply_transform(transform), surface=surface)

    def project(self, points: Array) -> LumenProjection:
        """Describe the surface near points as a path with a radius; the margin is taken off.

        Parameters
        ----------
        points : ndarray
            Points (.., 3), mm.

        Returns
        -------
        LumenProjection
            A path and a radius for each point, whose lumen has the wall of the body there to second order.
        """
        return self.field.project(points, self.sign, self.margin)

    def room(self, points: Array) -> Array:
        """Compute how far points are from the surface, on the side where the robot may be.

        Parameters
        ----------
        points : ndarray
            Points (n, 3), mm.

        Returns
        -------
        ndarray
            Distances (n,), mm, less the margin, negative on the other side; from the triangles where they are
            known, elsewhere from the field.
        """
        distance = (
            self.field.evaluate(points)[0] if self.surface is None else self.surface.signed_distances(points)
        )
        return self.sign * distance - self.margin

    def surface_near(self, points: Array, within: float = 15.0) -> Surface:
        """Return the part of the surface around points, for pictures.

        Parameters
        ----------
        points : ndarray
            Points (n, 3), mm, as those of a path.
        within : float
            Distance from the nearest of them, mm.

        Returns
        -------
        Surface
            The triangles that are so near.

        Raises
        ------
        ProblemError
            The body has no triangles, or none is so near.
        """
        if self.surface is None:
            raise ProblemError(f"the wall {self.name!r} is known as a distance field alone; it has no triangles")
        away = cKDTree(points).query(self.surface.corners.mean(axis=1))[0]
        if not (away <= within).any():
            raise ProblemError(f"the wall {self.name!r} is {away.min():.1f} mm away; {within:g} mm were asked for")
        return self.surface.keep_triangles(away <= within)


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

    @property
    def each(self) -> list[WallGeometry]:
        """The walls one by one: the lumen, where it is one, and the bodies."""
        return [*([] if self.lumen is None else [self.lumen]), *self.bodies]

    @property
    def names(self) -> list[str]:
        """Names of the walls, in the order of `each`."""
        return [*([] if self.lumen is None else [LUMEN_NAME]), *(body.name for body in self.bodies)]

    def project(self, points: Array) -> LumenProjection:
        """Describe the nearest wall near points (.., 3), mm, as a path with a radius."""
        each = [wall.project(points) for wall in self.each]
        nearest = np.argmin([near.radius - near.distance for near in each], axis=0)
        stacked = (np.stack(parts) for parts in zip(*each, strict=True))
        return LumenProjection(*(_pick(parts, nearest) for parts in stacked))


def _pick(parts: Array, nearest: Index) -> Array:
    """Return parts (walls, .., *rest) at the nearest (..,) wall of each point."""
    index = nearest.reshape(nearest.shape + (1,) * (parts.ndim - 1 - nearest.ndim))
    return np.asarray(np.take_along_axis(parts, index[None], axis=0)[0])


def is_lumen_wall(bodies: tuple[Body, ...]) -> bool:
    """Return whether the lumen around a path is a wall beside bodies.

    It is none where the robot stays inside of one of them: airways are not round, and the body is what they are.
    """
    return all(body.keep_out for body in bodies)


def nearest_of(lumen: Lumen | None, bodies: tuple[Body, ...]) -> WallGeometry | None:
    """Return the wall of a lumen and bodies; None where there is none.

    lumen: around the path; see is_lumen_wall.
    """
    if not bodies:
        return lumen
    walls = Walls(lumen if is_lumen_wall(bodies) else None, bodies)
    if len(set(walls.names)) < len(walls.names):
        raise ProblemError(f"walls are named {', '.join(walls.names)}; each must have a name of its own")
    return walls
