r"""A lower bound on the distance of the tip from the end of the path, over all configurations of the last frame.

The unknowns of the elastic model are the angles of the tubes at their tips, their extensions and the turn of the
whole robot: every choice is an equilibrium, so that a search through a box of them sees all equilibria, stable or
not (models/elastic/torsion.py). The bound is found by branch and bound (Horst and Tuy, Global Optimization):

- A cell is a box of tip angles psi_i relative to a reference tube, and of extensions. Its shapes are turned about
  the insertion point so that the tip points at the end; what is left of the turn of the whole robot is the spin
  about the line to the end, which is cut into bins.
- Point j of the body moves by at most rho_j within a cell: the sum over the cell's axes of the larger change
  towards both sides, measured at the cell's borders and raised by CHANGE_FACTOR, and half a bin of spin.
- With contact t_j at the cell's middle, every configuration of the cell needs another turn of the whole robot, by
  an angle a with |x_j| a >= t_j - rho_j - c for contact of at most c. It takes the tip away from the end by
  m^2 = (|p| - |T|)^2 + 4 |p| |T| sin^2(a/2), where p is the tip and T the end.
- The least m over all cells is the bound. Cells with the least are divided, until time is up.

The changes rho_j are measured, not proven: the bound holds at this resolution, as tests with random configurations
check. Tilt limits are left out, and so are carriages and speeds: robots that have them can do less.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from ctr_nlp.exceptions import OptionError, ProblemError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.distance_field import perpendicular_axes
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import PHYSICAL_MODEL
from ctr_nlp.support.value_checks import number
from ctr_nlp.typing import Array

BODY_POINTS = 24
"""Points along the robot at which contact is looked at."""
SPIN_BINS = 72
"""Bins of the turn of the whole robot about the line from the insertion point to the end."""
CHANGE_FACTOR = 1.25
"""Factor on changes measured at the borders of a cell, for what their sum leaves out."""
ROOM_SPACING_MM = 1.2
"""Distance between the nodes of the grid on which the room within the wall is interpolated, mm."""
ROOM_ERROR_MM = 0.25
"""By how much the interpolated room may be too small, mm: fields round off narrow lumens, by 0.21 mm at most in
the mask of the tests."""
ROOM_AROUND_MM = 15.0
"""How far around the path the room is known, mm; beyond, nothing is excluded."""
ANGLE_CELLS, EXTENSION_CELLS, REACH_CELLS = 6, 2, 8
"""Cells along each angle, along the extension of each outer tube, and along that of the innermost, to begin with:
changes across larger cells say little about what is in them."""
CELLS_AT_ONCE = 128
"""Cells that are divided together."""
UNKNOWN_ROOM_MM = 50.0
"""Room that is assumed where it is not known, mm: such places exclude nothing."""
MAX_OPEN_CELLS = 400_000
"""Open cells at which the search ends before its time, for the memory that they take."""


@dataclass(frozen=True)
class MissBound:
    """A lower bound on the miss of the tip.

    Attributes
    ----------
    miss : float
        No configuration brings the tip nearer to the end of the path than this, mm, with the contact allowed.
    contact : float
        Contact that is allowed, mm.
    cells : int
        Number of cells that were looked at.
    narrowest : ndarray
        Half-widths (2d - 1,) of the smallest cells: tip angles, rad, then extensions as parts of their ranges.
    complete : bool
        Whether the search ended since no open cell was below `enough`.
    seconds : float
        Duration of the search, s.
    """

    miss: float
    contact: float
    cells: int
    narrowest: Array
    complete: bool
    seconds: float


def bound_miss(
    problem: Problem,
    contact: float | None = None,
    *,
    time_limit: float = 20.0,
    enough: float = math.inf,
) -> MissBound:
    """Find how near the robot's tip can come to the end of the path at best.

    Parameters
    ----------
    problem : Problem
        The problem; its last target frame, its robot and its wall count.
    contact : float, optional
        Contact with the wall that is allowed, mm; by default that of :class:`Settings`.
    time_limit : float
        Processor time of the search, s; the first cells are looked at in any case, which takes a second.
    enough : float
        Bound at which the search ends, mm, such as the least miss that is known.

    Returns
    -------
    MissBound
        The bound; 0 where the search proves nothing.

    Raises
    ------
    ProblemError
        The problem has no wall.
    OptionError
        A number is out of its range.

    Examples
    --------
    >>> from ctr_nlp.paths.named_problems import named_problem
    >>> bound_miss(named_problem("bronchus", frames=5), time_limit=0.1).miss
    0.0
    """
    if contact is None:
        contact = Settings().contact_allowed
    number(OptionError, "contact", contact, lambda x: 0 <= x < math.inf, "be at least 0 mm", " mm")
    number(OptionError, "time_limit", time_limit, lambda x: x > 0, "be positive", " s")
    search = _Search(problem, contact)
    begin = time.process_time()
    lower, upper = search.divide_range()
    found = [
        search.bound_cells(lower[k : k + CELLS_AT_ONCE], upper[k : k + CELLS_AT_ONCE])
        for k in range(0, len(lower), CELLS_AT_ONCE)
    ]
    bounds, split_next = (np.concatenate(parts) for parts in zip(*found, strict=True))
    cells = len(bounds)
    narrowest = (upper - lower)[0] / 2
    while time.process_time() - begin < time_limit and bounds.min() < enough and len(bounds) < MAX_OPEN_CELLS:
        some = np.argsort(bounds, kind="stable")[:CELLS_AT_ONCE]
        rest = np.ones(len(bounds), bool)
        rest[some] = False
        new_lower, new_upper = _divide(lower[some], upper[some], split_next[some])
        below, widest = search.bound_cells(new_lower, new_upper)
        # What holds in a cell holds in its parts, too.
        below = np.maximum(below, np.repeat(bounds[some], 2))
        cells += len(below)
        narrowest = np.minimum(narrowest, (new_upper - new_lower).min(axis=0) / 2)
        kept = below < enough
        lower = np.concatenate([lower[rest], new_lower[kept]])
        upper = np.concatenate([upper[rest], new_upper[kept]])
        split_next = np.concatenate([split_next[rest], widest[kept]])
        bounds = np.concatenate([bounds[rest], below[kept]])
        if not len(bounds):
            break
    least = float(min(bounds.min(initial=enough), enough))
    complete = not len(bounds) or least >= enough
    return MissBound(least, contact, cells, narrowest, complete, time.process_time() - begin)


def _divide(lower: Array, upper: Array, axis: Array) -> tuple[Array, Array]:
    """Halve cells (n, k) along an axis each; the two halves of a cell follow each other."""
    rows = np.arange(len(lower))
    middle = (lower[rows, axis] + upper[rows, axis]) / 2
    low = np.repeat(lower, 2, axis=0)
    high = np.repeat(upper, 2, axis=0)
    high[2 * rows, axis] = middle
    low[2 * rows + 1, axis] = middle
    return low, high


class _Search:
    """Cells of configurations of a robot, and the bounds on the miss in them."""

    def __init__(self, problem: Problem, contact: float) -> None:
        if problem.wall is None:
            raise ProblemError("the problem has no wall; give a path with radii, or a mask")
        self._robot = problem.robot
        self._contact = contact
        frame = problem.target_frames[-1]
        self._end = frame.points[-1]
        self._far = float(np.linalg.norm(self._end))
        self._room = _Room(problem, frame.points)
        low, high = (self._robot.split(ends)[1] for ends in (self._robot.lower, self._robot.upper))
        self._low = low
        self._high = np.append(high[:-1], self._robot.reach)
        self._sigma = np.linspace(0.0, 1.0, BODY_POINTS + 1)[1:]
        spins = (np.arange(SPIN_BINS) + 0.5) * (2 * np.pi / SPIN_BINS)
        self._cos = np.cos(spins)
        self._sin = np.sin(spins)
        self._axes = _axes_along(self._end / self._far)

    def divide_range(self) -> tuple[Array, Array]:
        """Return lower and upper ends (n, 2d - 1) of the cells that the search begins with."""
        d = self._robot.d
        counts = [*[ANGLE_CELLS] * (d - 1), *[EXTENSION_CELLS] * (d - 1), REACH_CELLS]
        first = np.array([-np.pi] * (d - 1) + [0.0] * d)
        width = np.array([2 * np.pi] * (d - 1) + [1.0] * d) / counts
        places = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1).reshape(-1, len(counts))
        lower = first + places * width
        return lower, lower + width

    def bound_cells(self, lower: Array, upper: Array) -> tuple[Array, Array]:
        """Bound the miss in cells (n, 2d - 1); also return the axis along which each changes most, (n,)."""
        n, k = lower.shape
        middle = (lower + upper) / 2
        half = (upper - lower) / 2
        # The middle, and the middles of both sides along every axis.
        sides = np.repeat(middle[:, None], 2 * k + 1, axis=1)
        for axis in range(k):
            sides[:, 1 + 2 * axis, axis] -= half[:, axis]
            sides[:, 2 + 2 * axis, axis] += half[:, axis]
        body, beta = self._shapes(sides.reshape(-1, k))
        body = body.reshape(n, 2 * k + 1, BODY_POINTS, 3)
        beta = beta.reshape(n, 2 * k + 1, -1)
        change = np.linalg.norm(body[:, 1:] - body[:, :1], axis=-1).reshape(n, k, 2, -1).max(axis=2)
        moves = CHANGE_FACTOR * change.sum(axis=1)
        length = body[:, 0, -1] @ (self._end / self._far)
        spread = CHANGE_FACTOR * np.abs(body[:, 1:, -1] - body[:, :1, -1]).max(axis=-1).reshape(n, k, 2).max(
            2
        ).sum(1)
        contact = self._contacts(body[:, 0], beta)
        # Half a bin of spin moves a point by its distance from the axis times the angle.
        along = body[:, 0] @ (self._end / self._far)
        lever = np.sqrt(np.maximum((body[:, 0] ** 2).sum(-1) - along**2, 0.0)) + moves
        needed = contact - moves[:, None] - lever[:, None] * (np.pi / SPIN_BINS) - self._contact
        distance = np.linalg.norm(body[:, 0], axis=-1) + moves
        angle = np.clip(needed / np.maximum(distance, 1e-9)[:, None], 0.0, np.pi).max(axis=-1).min(axis=-1)
        gap = np.maximum(np.abs(length - self._far) - spread, 0.0)
        shortest = np.maximum(length - spread, 0.0)
        bound = np.sqrt(gap**2 + 4 * shortest * self._far * np.sin(angle / 2) ** 2)
        return bound, change.max(axis=-1).argmax(axis=1)

    def _contacts(self, body: Array, beta: Array) -> Array:
        """Return contact (n, spins, points), mm, of bodies (n, points, 3) whose tips point at the end."""
        first, second, along = self._axes
        # Turned about the line to the end by every spin.
        a, b, c = body @ first, body @ second, body @ along
        across = (self._cos[:, None] * a[:, None] - self._sin[:, None] * b[:, None])[..., None] * first
        across = across + (self._sin[:, None] * a[:, None] + self._cos[:, None] * b[:, None])[..., None] * second
        points = across + (c[..., None] * along)[:, None]
        # The thinnest tube that may be outermost at a point, anywhere in the cell.
        spread = (
            np.abs(beta[:, 1:] - beta[:, :1]).reshape(len(beta), -1, 2, beta.shape[-1]).max(axis=2).sum(axis=1)
        )
        surely = beta[:, 0] - spread
        deepest = self._sigma * (beta[:, 0, -1] + spread[:, -1])[:, None]
        radii = np.array([tube.outer_diameter / 2 for tube in self._robot.tubes])
        covers = surely[:, None, :-1] >= deepest[..., None]
        radius = np.maximum(np.where(covers, radii[:-1], 0.0).max(axis=-1, initial=0.0), radii[-1])
        return radius[:, None] - self._room(points) - ROOM_ERROR_MM

    def _shapes(self, cells: Array) -> tuple[Array, Array]:
        """Return bodies (n, points, 3) at places (n, 2d - 1) of cells, turned to the end, and beta (n, d)."""
        d = self._robot.d
        beta = np.empty((len(cells), d))
        beta[:, -1] = self._low[-1] + cells[:, -1] * (self._high[-1] - self._low[-1])
        for i in range(d - 2, -1, -1):
            # Parts of what the tube around it leaves: every cell is in order.
            top = np.maximum(np.minimum(self._high[i], beta[:, i + 1]), self._low[i])
            beta[:, i] = self._low[i] + cells[:, d - 1 + i] * (top - self._low[i])
        # Angles relative to the tube before the innermost, which mostly sets the shape of the body: turning the
        # innermost alone then moves its own part alone.
        reference = max(d - 2, 0)
        psi = np.zeros((len(cells), d))
        psi[:, [i for i in range(d) if i != reference]] = cells[:, : d - 1]
        x = np.zeros((len(cells), 2 * d + 2))
        x[:, : d - 1] = psi[:, :-1] - psi[:, -1:]
        x[:, d - 1] = psi[:, -1]
        x[:, d : 2 * d] = beta
        body = KINEMATIC_MODELS[PHYSICAL_MODEL].points(self._robot, x, self._sigma)
        return _turn_towards(body, self._end / self._far), beta


class _Room:
    """Room within the wall around a path, mm, interpolated on a grid; large where it is not known."""

    def __init__(self, problem: Problem, path: Array) -> None:
        assert problem.wall is not None
        self._origin = path.min(axis=0) - ROOM_AROUND_MM
        shape = np.ceil((np.ptp(path, axis=0) + 2 * ROOM_AROUND_MM) / ROOM_SPACING_MM).astype(int) + 1
        nodes = np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1).reshape(-1, 3)
        points = self._origin + ROOM_SPACING_MM * nodes
        near = cKDTree(path).query(points, distance_upper_bound=ROOM_AROUND_MM)[0] < np.inf
        room = np.full(len(points), UNKNOWN_ROOM_MM)
        found = problem.wall.project(points[near])
        room[near] = found.radius - found.distance
        self._values = room.reshape(shape).astype(np.float32)

    def __call__(self, points: Array) -> Array:
        """Return the room (..) at points (.., 3), mm."""
        places = np.moveaxis((points - self._origin) / ROOM_SPACING_MM, -1, 0)
        found: Array = map_coordinates(
            self._values, places, output=float, order=1, mode="constant", cval=UNKNOWN_ROOM_MM
        )
        return found


def _axes_along(direction: Array) -> tuple[Array, Array, Array]:
    """Return three perpendicular unit vectors, the last of them `direction` (3,)."""
    first, second = perpendicular_axes(direction[None])
    return first[0], second[0], direction


def _turn_towards(body: Array, direction: Array) -> Array:
    """Turn bodies (n, points, 3) about the origin so that their tips point along a unit vector (3,).

    By the smallest rotation; bodies whose tips point the other way are turned about any axis across it.
    """
    tip = body[:, -1] / np.maximum(np.linalg.norm(body[:, -1], axis=-1, keepdims=True), 1e-12)
    # Two half turns make the rotation: about the bisector, which takes the tip to the direction, and about that.
    bisector = tip + direction
    norm = np.linalg.norm(bisector, axis=-1, keepdims=True)
    other = np.broadcast_to(_axes_along(direction)[0], bisector.shape)
    bisector = np.where(norm > 1e-9, bisector / np.maximum(norm, 1e-9), other)
    mirrored = 2 * (body * bisector[:, None]).sum(-1, keepdims=True) * bisector[:, None] - body
    return 2 * (mirrored @ direction)[..., None] * direction - mirrored
