"""The lumen's wall as a soft constraint: where on the robot it is looked at, and what it is like there.

Every tube's visible part is looked at in PLACES places, each with the path near to it to second order and the wall
to first. What there is less room between two places is taken from the room at the second. All of that holds near a
configuration only: a solution is looked at again, and the NLP solved again, until nothing changes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.formulations.settings import Settings
from ctr_nlp.models import Shape, dominant
from ctr_nlp.models.symbolic import columns_of
from ctr_nlp.nlp import terms
from ctr_nlp.nlp.nlp import Inner, Nlp
from ctr_nlp.robot import Robot
from ctr_nlp.simulation.forward import points_of
from ctr_nlp.target.curve import Curve
from ctr_nlp.target.lumen import Lumen, outer_radius
from ctr_nlp.typing import Array

PLACES = 12
"""On every tube; the last is its tip."""
FINER = 5
"""Samples a place, between it and the one before."""
COLUMNS = 13
"""Numbers that describe the wall at a place: centre, tangent, bend, room, taper, behind and ahead."""
ROUNDS = 12
"""Times that an NLP is solved around its own solution."""
SETTLED = 0.01
"""mm by which the slack of a solution may differ from what it needs."""
ROOM = 9
"""Which of them the room is."""
FAR = 1e3
"""mm: room enough."""
TINY = 1e-9
"""mm, 1/mm: what stands for nothing in a denominator."""


def wall_of(robot: Robot, lumen: Curve | None, model: str, settings: Settings) -> Wall | None:
    """That of a path with radii, None where there is none or it does not count."""
    if lumen is None or not settings.contact_weight:
        return None
    return Wall(robot, Lumen.around(lumen), model, settings.contact_weight, settings.clearance)


@dataclass(frozen=True)
class Wall:
    """That of a lumen around a robot on a model.

    weight: what a mm of contact costs, mm^2. clearance: mm that are to be kept.
    """

    robot: Robot
    lumen: Lumen
    model: str
    weight: float
    clearance: float

    def cost(self, slack: Array) -> Array:
        """Of slacks, mm^2."""
        return np.asarray(terms.contact(slack, self.weight).value)

    def away(self) -> dict[str, Any]:
        """Parameters of a frame that no wall is near to."""
        wall = np.zeros((self.robot.d * PLACES, COLUMNS))
        wall[:, ROOM] = FAR
        return {"wall": wall, "contact_weight": 0.0}

    def surroundings(self, x: Array) -> tuple[dict[str, Array], Array]:
        """Parameters (T, ..) of frames near to unknowns x (T, 2d + 2) of the model, and slacks (T,) needed, mm.

        Bends sharper than the lumen is wide are noise of the path's points.
        """
        beta = dominant.columns_of(x[:, self.robot.d : 2 * self.robot.d])
        sigma = np.hstack(arc_lengths(beta, PLACES * FINER)) / np.maximum(beta[-1], TINY)
        near = self.lumen.near(points_of(self.robot, x, sigma, self.model))
        room = near.radius - np.repeat(outer_radius(self.robot), PLACES * FINER) - self.clearance
        left = room - np.hypot(near.distance, terms.CENTRED)
        room -= left - np.repeat(left.reshape(len(x), -1, FINER).min(axis=-1), FINER, axis=-1)
        numbers = np.stack([room, near.taper, near.behind, near.ahead], axis=-1)
        sharpest = 1.0 / near.radius / np.maximum(np.linalg.norm(near.bend, axis=-1), TINY)
        bend = near.bend * np.minimum(sharpest, 1.0)[..., None]
        wall = np.concatenate([near.centre, near.tangent, bend, numbers], axis=-1)
        described = {"wall": wall[:, FINER - 1 :: FINER], "contact_weight": np.full(len(x), self.weight)}
        return described, np.maximum(-left.min(axis=1), 0.0)


def arc_lengths(beta: Sequence[Any], count: int = PLACES) -> list[Any]:
    """Arc lengths, mm, of so many places on every tube's visible part, the last of which is its tip."""
    starts = [0 * beta[0], *(beta[i] for i in range(len(beta) - 1))]
    fractions = np.arange(1.0, count + 1) / count
    return [start + fractions * (end - start) for start, end in zip(starts, beta, strict=True)]


def walled(frame: Nlp, shape: Shape) -> Nlp:
    """A frame whose shape's last samples are the places, kept within the wall; one more unknown, a slack in mm."""
    n, places = frame.x.numel(), len(shape.beta) * PLACES
    wall, slack, weight = ca.SX.sym("wall", places, COLUMNS), ca.SX.sym("slack"), ca.SX.sym("contact_weight")
    points = Inner.of([ca.horzcat(*(axis[-places:] for axis in shape.placed()))])
    at, *path = (columns_of(matrix) for matrix in (points.symbols[0], wall[:, :3], wall[:, 3:6], wall[:, 6:9]))
    return replace(
        frame,
        x=ca.vertcat(frame.x, slack),
        lower=np.append(frame.lower, 0.0),
        upper=np.append(frame.upper, np.inf),
        parameters={**frame.parameters, "wall": wall, "contact_weight": weight},
        costs=(*frame.costs, terms.contact(slack, weight)),
        inner=(*frame.inner, points),
        constraints=(*frame.constraints, terms.clearance(at, path, ca.horzsplit(wall[:, ROOM:]), slack)),
        picks=tuple(range(n)) if frame.picks is None else tuple(pick + (pick >= n) for pick in frame.picks),
        slacks=1,
    )
