"""The lumen's wall as a soft constraint.

At sample points on the robot, r(p) - |C - p| - rho + z >= c with one slack z >= 0 for all of them (mm), at a cost
w z: an exact penalty, for which z = 0 wherever the clearance c can be kept at a smaller cost. r is the lumen's
radius at the path's nearest point p, and rho the tube's outer radius. Near a configuration the path is described
to second order and the radius to first (ocp/wall.py). A wall that is a distance field stands there as a path whose
distance counts as often as the field is steep.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.models.inner import Inner
from ctr_nlp.models.protocol import columns_of
from ctr_nlp.ocp.nlp import Constraint, CostTerm
from ctr_nlp.ocp.terms.arrival import smooth_excess
from ctr_nlp.ocp.terms.term import Body, Parts, Symbols, Term
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot.structure import Structure
from ctr_nlp.typing import Array, Vector

WALL_SAMPLES_PER_TUBE = 12
"""Sample points on every tube's visible part; the last is its tip."""
WALL_SUBSAMPLES = 3
"""Places at which the wall is looked at for every sample point: the point itself and others beside it."""
WALL_COLUMN_COUNT = 14
"""Numbers that describe the wall at a place: centre (3), tangent (3), bend (3), room, taper, behind, ahead
and slope.
"""
WALL_ROOM_COLUMN, WALL_SLOPE_COLUMN = 9, 13
"""Columns of the room and of the slope; those before the room are vectors."""
NO_WALL_ROOM_MM = 1e3
"""Room in mm that no robot fills: it stands for no wall."""
SLACK_SQUARE_COST = 1e-3
"""Coefficient of the slack's square in its cost, mm^2 a mm^2: it keeps Hessians definite where contact costs
nothing, too.
"""
EXCESS_CONTACT_FACTOR = 20.0
"""How many times more contact costs beyond what is allowed. By default a mm costs, in mm^2 and in one frame, 30 of
contact that is allowed, 150 of the tip's distance beyond its tolerance (terms/arrival.py), and 600 of contact
beyond what is allowed: that is the order of priorities, before the shape's error.
"""
CENTRELINE_SMOOTHING_MM = 0.01
"""Distance in mm that rounds off the distance to the path where that is 0, and its slope undefined."""


def room_beside_path(points: Vector, path: Sequence[Vector], wall: Sequence[ca.SX]) -> ca.SX:
    """Return the room (n, 1) that the lumen leaves a robot beside a path, mm; negative in contact.

    points: x, y, z, each (n, 1) mm. path: its point near each, its tangent and its bend, 1/mm, in the same axes.
    wall, each (n, 1): the room there, mm, how much more there is a mm further, how far the path continues behind
    and ahead, mm, and how much less room there is a mm farther from the path.
    """
    (centre, tangent, bend), (room, taper, behind, ahead, slope) = path, wall
    away = [points[i] - centre[i] for i in range(3)]
    # Along the tangent to the foot of the perpendicular, but not beyond the path's ends.
    further = ca.fmax(ca.fmin(sum(away[i] * tangent[i] for i in range(3)), ahead), -behind)
    # The path to second order: centre + f tangent + f^2 / 2 bend.
    across = [away[i] - further * tangent[i] - further**2 / 2 * bend[i] for i in range(3)]
    # CENTRELINE_SMOOTHING_MM keeps the root's slope finite on the path itself, where the direction to the wall is
    # undefined.
    distance = ca.sqrt(sum(part**2 for part in across) + CENTRELINE_SMOOTHING_MM**2)
    return room + taper * further - slope * distance


def room_at_samples(body: Body, wall: ca.SX) -> tuple[Inner, ca.SX]:
    """Return the points of body, (n, 3) as inner symbols, and the room there in mm, written in these.

    wall: parameters that describe it, a row a subsample: the first of every sample point, then the second of every
    one. Programs know how a sample point moves, and the places beside it are taken to move as it does. The room
    has as many rows.
    """
    # As a layer of their own: the wall's second derivatives are taken over three coordinates a sample point, not
    # over x.
    points = Inner.of([ca.SX(ca.horzcat(*body.points))])
    at = columns_of(points.symbols[0])
    # All rows of a sample point share its symbols: the sparsity of second derivatives stays 3 by 3 a sample point,
    # however many places are looked at.
    rooms = list[ca.SX]()
    for rows in ca.vertsplit(wall, at[0].numel()):
        path = [columns_of(each) for each in (rows[:, :3], rows[:, 3:6], rows[:, 6:9])]
        rooms.append(room_beside_path(at, path, ca.horzsplit(rows[:, WALL_ROOM_COLUMN:])))
    return points, ca.vertcat(*rooms)


def contact_penalty(slack: Any, weight: Any, allowed: Any) -> Any:
    """Return the exact penalty on the depth of contact, mm^2.

    Parameters
    ----------
    slack : float, array or casadi expression
        Depth by which the clearance is missed, mm.
    weight : float or casadi expression
        Cost of a mm of it, mm^2.
    allowed : float or casadi expression
        Depth from which a mm costs EXCESS_CONTACT_FACTOR times as much, mm.

    Returns
    -------
    float, array or casadi expression
        weight slack + (EXCESS_CONTACT_FACTOR - 1) weight max(slack - allowed, 0), the second corner rounded, +
        SLACK_SQUARE_COST slack^2.
    """
    return (
        weight * slack
        + (EXCESS_CONTACT_FACTOR - 1) * weight * smooth_excess(slack - allowed)
        + SLACK_SQUARE_COST * slack**2
    )


def arc_lengths(beta: Sequence[Any], count: int = WALL_SAMPLES_PER_TUBE) -> list[Any]:
    """Return arc lengths, mm, of `count` sample points on every tube's visible part, the last of which is its tip.

    beta: extensions, mm.
    """
    starts = [0 * beta[0], *(beta[i] for i in range(len(beta) - 1))]
    fractions = np.arange(1.0, count + 1) / count
    return [start + fractions * (end - start) for start, end in zip(starts, beta, strict=True)]


def wall_parameters(d: int, subsamples: int) -> dict[str, tuple[int, int]]:
    """Return the shapes of the parameters that describe the wall near a robot of d tubes, by name.

    subsamples: for each sample point.
    """
    return {
        "wall": (subsamples * d * WALL_SAMPLES_PER_TUBE, WALL_COLUMN_COUNT),
        "contact_weight": (1, 1),
        "contact_allowed": (1, 1),
    }


def no_wall_parameters(d: int, subsamples: int) -> dict[str, Any]:
    """Return the parameters of a frame of d tubes with no wall nearby; subsamples: for each sample point."""
    wall = np.zeros(wall_parameters(d, subsamples)["wall"])
    # Zero vectors and much room: rows that are always satisfied, and a weight of 0.
    wall[:, WALL_ROOM_COLUMN] = NO_WALL_ROOM_MM
    wall[:, WALL_SLOPE_COLUMN] = 1.0
    return {"wall": wall, "contact_weight": 0.0, "contact_allowed": 0.0}


@dataclass(frozen=True)
class LumenClearance(Term):
    """Clearance at WALL_SAMPLES_PER_TUBE sample points of every tube, and the cost of contact; d: number of tubes.

    The parameters that describe the wall near the robot are filled in by wall.py; without them there is no wall.
    """

    d: int
    name = "lumen"

    def sample_arc_lengths(self, beta: Sequence[ca.SX]) -> ca.SX:
        """Return the arc lengths of the sample points on every tube, mm, at extensions beta in mm."""
        return ca.vertcat(*arc_lengths(beta))

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return the shapes of wall, a row a subsample.

        Those of contact_weight, mm^2 a mm, and contact_allowed, mm. structure: not used.
        """
        return wall_parameters(self.d, WALL_SUBSAMPLES)

    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return WALL_SUBSAMPLES smooth constraints a sample point of body, and one slack for all.

        parameters: symbols by name.
        """
        slack = ca.SX.sym("slack")
        points, room = room_at_samples(body, parameters["wall"])
        # room + slack >= 0 at and beside every sample point: the slack is the deepest contact, and its cost counts
        # once a frame.
        bounds = np.zeros(room.numel()), np.full(room.numel(), np.inf)
        return Parts(
            costs=(
                CostTerm(
                    "contact", contact_penalty(slack, parameters["contact_weight"], parameters["contact_allowed"])
                ),
            ),
            constraints=(Constraint("clearance", room + slack, *bounds),),
            inner=(points,),
            slack=slack,
        )

    def fill(self, frame: Frame) -> Mapping[str, Array]:
        """Return the parameters of a frame without a wall nearby, the same for every frame."""
        return no_wall_parameters(self.d, WALL_SUBSAMPLES)
