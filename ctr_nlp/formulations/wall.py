"""A lumen's wall as programs see it: at some places along the robot, linearised near its configuration.

Every tube's visible part is looked at in terms.lumen.PLACES places, each with the lumen's path nearby to second
order and the wall's radius to first order. Where there is less room between two places, the room at the second is
reduced to it. This holds near a configuration only: a solution is looked at again, and the program solved again,
until nothing changes. Clearance is r(p) - |C - p| - rho in mm, with the radius r at the path's nearest point p and
the outer radius rho of the outermost tube (docs/method.md, "The lumen's wall").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import cached_property, partial
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.formulations.around import Around
from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.terms.lumen import CENTRED, PLACES, arc_lengths, contact
from ctr_nlp.models import Model
from ctr_nlp.models.dominant.shape import columns_of
from ctr_nlp.robot import Robot
from ctr_nlp.target.lumen import Lumen, outer_radius
from ctr_nlp.target.target import Frame
from ctr_nlp.typing import Array

FINER = 5
"""Number of samples for each place, from the place before up to this one."""
ROUNDS = 12
"""Most times that a program is solved around its own solution."""
SETTLED = 0.01
"""Difference in mm up to which the slack of a solution counts as the one that it needs."""
PLANNED_PART = 0.8
"""Part of the allowed contact beyond which it costs more in planning: penalties give a little, and programs look
at the wall in fewer places than the verdict does.
"""
TINY = 1e-9
"""Replaces 0 in denominators, mm and 1/mm."""


def wall_of(
    robot: Robot, lumen: Lumen | None, model: Model, settings: Settings, finer: int = FINER
) -> Wall | None:
    """The wall of a lumen; None where there is no lumen or contact costs nothing.

    settings: weight, clearance and allowed contact. finer: samples a place, see Wall.
    """
    if lumen is None or not settings.contact_weight:
        return None
    return Wall(robot, lumen, model, settings.contact_weight, settings.clearance, settings.contact_allowed, finer)


@dataclass(frozen=True)
class Wall:
    """The wall of a lumen around a robot on a model.

    weight: cost of a mm of contact, mm^2. clearance: mm that are to be kept. contact_allowed: mm beyond the wall
    from which contact costs more. finer: samples for each place, between it and the one before.
    """

    robot: Robot
    lumen: Lumen
    model: Model
    weight: float
    clearance: float
    contact_allowed: float = math.inf
    finer: int = FINER

    def cost(self, slack: Array) -> Array:
        """Cost of slacks, mm^2, each as in terms.lumen.contact."""
        return np.asarray(ca.DM(contact(ca.DM(slack), self.weight, self.allowed)).full().reshape(np.shape(slack)))

    @property
    def allowed(self) -> float:
        """Depth by which the clearance may be missed before contact costs more, mm."""
        return self.clearance + PLANNED_PART * self.contact_allowed

    @cached_property
    def around(self) -> Around | None:
        """The wall in C; None where nothing can be compiled."""
        if cache.missing():
            return None
        return Around(self.robot, self.lumen, self.model, self.clearance, self.finer, TINY)

    def __getstate__(self) -> dict[str, Any]:
        # Cached objects of C cannot be pickled; another process finds its own.
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def during(self, frames: Sequence[Frame]) -> Callable[[Array], tuple[dict[str, Array], Array]]:
        """A function of unknowns x (T, n) in these frames that returns their surroundings, under the load of their
        time.
        """
        bears = self.model.bears
        acting = None if bears is None else bears.over(self.robot.d, np.array([frame.part for frame in frames]))
        return partial(self.surroundings, loads=acting)

    def surroundings(
        self, x: Array, numbers: Array | None = None, loads: Array | None = None
    ) -> tuple[dict[str, Array], Array]:
        """Parameters (T, ..) of frames near unknowns x (T, n) of the model, by name, and slacks (T,) needed, mm.

        numbers (d, 8): of the tubes, where they are not the robot's. loads (T, 17 + 3d): on models with loads.
        """
        found = self.around
        wall, slack = (self.described if found is None or not found.ready() else found)(x, numbers, loads)
        # A row a frame, as Chain.with_parameters and the scenarios take them.
        weight, allowed = np.full(len(x), self.weight), np.full(len(x), self.allowed)
        return {"wall": wall, "contact_weight": weight, "contact_allowed": allowed}, slack

    def of_scenarios(self, x: Array, numbers: Array, loads: Array | None = None) -> dict[str, Array]:
        """Parameters (T, S, ..) near unknowns x (T, S, n) of robots whose tubes have numbers (S, d, 8), by name.

        loads (T, S, 17 + 3d): on models with loads.
        """
        found = [
            self.surroundings(x[:, k], own, None if loads is None else loads[:, k])[0]
            for k, own in enumerate(numbers)
        ]
        return {name: np.stack([each[name] for each in found], axis=1) for name in found[0]}

    def described(self, x: Array, numbers: Array | None = None, loads: Array | None = None) -> tuple[Array, Array]:
        """Numbers that describe the wall (T, d PLACES, COLUMNS), and slacks (T,), without compiled code.

        Arguments as in surroundings. Bends sharper than the lumen is wide are noise of the path's points.
        """
        beta = columns_of(self.model.extensions(self.robot, x))
        # Arc lengths over beta_d; a robot that is not out at all has samples at 0.
        sigma = np.hstack(arc_lengths(beta, PLACES * self.finer)) / np.maximum(beta[-1], TINY)
        near = self.lumen.near(self._points(x, sigma, numbers, loads))
        room = near.radius - np.repeat(outer_radius(self.robot), PLACES * self.finer) - self.clearance
        # The same rounded distance as in the program (terms.lumen.left), so that both agree on the slack.
        left = room - np.hypot(near.distance, CENTRED)
        # The room at a place is reduced by what is less between the place before and it: the least of its
        # samples.
        room -= left - np.repeat(left.reshape(len(x), -1, self.finer).min(axis=-1), self.finer, axis=-1)
        numbers = np.stack([room, near.taper, near.behind, near.ahead], axis=-1)
        # Curvature of the path at most 1 / r.
        sharpest = 1.0 / near.radius / np.maximum(np.linalg.norm(near.bend, axis=-1), TINY)
        bend = near.bend * np.minimum(sharpest, 1.0)[..., None]
        # In the order of terms.lumen.COLUMNS: three vectors, then four numbers.
        wall = np.concatenate([near.centre, near.tangent, bend, numbers], axis=-1)
        # The last sample of each place is the place itself.
        return wall[:, self.finer - 1 :: self.finer], np.maximum(-left.min(axis=1), 0.0)

    def _points(self, x: Array, sigma: Array, numbers: Array | None, loads: Array | None) -> Array:
        """Points (T, m, 3) in mm of the robot at x and sigma (T, m)."""
        tubes = (self.robot.numbers if numbers is None else numbers)[None]
        if loads is not None:
            return self.model.points_under(loads, self.robot.structure, tubes, x, sigma)
        found: Array = self.model.points_apart(self.robot.structure, tubes, x[None], sigma)[0]
        return found
