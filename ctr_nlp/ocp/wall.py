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
from ctr_nlp.models import Model
from ctr_nlp.models.dominant.shape import columns_of
from ctr_nlp.ocp.compiled_wall import CompiledWall
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.ocp.terms.lumen import CENTRELINE_SMOOTHING_MM, WALL_SAMPLES_PER_TUBE, arc_lengths, contact_penalty
from ctr_nlp.paths.lumen import Lumen, tube_outer_radii
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array

WALL_SUBSAMPLES = 5
"""Number of samples for each place, from the place before up to this one."""
MAX_WALL_RELINEARISATIONS = 12
"""Most times that a program is solved around its own solution."""
WALL_SLACK_TOLERANCE_MM = 0.01
"""Difference in mm up to which the slack of a solution counts as the one that it needs."""
PLANNED_CONTACT_FRACTION = 0.8
"""Part of the allowed contact beyond which it costs more in planning: penalties give a little, and programs look
at the wall in fewer places than the verdict does.
"""
WALL_MIN_DENOMINATOR = 1e-9
"""Replaces 0 in denominators, mm and 1/mm."""


def make_wall(
    robot: Robot, lumen: Lumen | None, model: Model, settings: Settings, subsamples: int = WALL_SUBSAMPLES
) -> Wall | None:
    """The wall of a lumen; None where there is no lumen or contact costs nothing.

    settings: weight, clearance and allowed contact. subsamples: samples a place, see Wall.
    """
    if lumen is None or not settings.contact_weight:
        return None
    return Wall(
        robot, lumen, model, settings.contact_weight, settings.clearance, settings.contact_allowed, subsamples
    )


@dataclass(frozen=True)
class Wall:
    """The wall of a lumen around a robot on a model.

    weight: cost of a mm of contact, mm^2. clearance: mm that are to be kept. contact_allowed: mm beyond the wall
    from which contact costs more. subsamples: samples for each place, between it and the one before.
    """

    robot: Robot
    lumen: Lumen
    model: Model
    weight: float
    clearance: float
    contact_allowed: float = math.inf
    subsamples: int = WALL_SUBSAMPLES

    def cost(self, slack: Array) -> Array:
        """Cost of slacks, mm^2, each as in terms.lumen.contact."""
        return np.asarray(
            ca.DM(contact_penalty(ca.DM(slack), self.weight, self.contact_threshold))
            .full()
            .reshape(np.shape(slack))
        )

    @property
    def contact_threshold(self) -> float:
        """Depth by which the clearance may be missed before contact costs more, mm."""
        return self.clearance + PLANNED_CONTACT_FRACTION * self.contact_allowed

    @cached_property
    def compiled_wall(self) -> CompiledWall | None:
        """The wall in C; None where nothing can be compiled."""
        if cache.unavailable_reason():
            return None
        return CompiledWall(
            self.robot, self.lumen, self.model, self.clearance, self.subsamples, WALL_MIN_DENOMINATOR
        )

    def __getstate__(self) -> dict[str, Any]:
        # Cached objects of C cannot be pickled; another process finds its own.
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def local_parameters_during(
        self, frames: Sequence[Frame]
    ) -> Callable[[Array], tuple[dict[str, Array], Array]]:
        """A function of unknowns x (T, n) in these frames that returns their surroundings, under the load of their
        time.
        """
        bears = self.model.applied_load
        acting = (
            None
            if bears is None
            else bears.numbers_at(self.robot.d, np.array([frame.motion_fraction for frame in frames]))
        )
        return partial(self.local_parameters, loads=acting)

    def local_parameters(
        self, x: Array, numbers: Array | None = None, loads: Array | None = None
    ) -> tuple[dict[str, Array], Array]:
        """Parameters (T, ..) of frames near unknowns x (T, n) of the model, by name, and slacks (T,) needed, mm.

        numbers (d, 8): of the tubes, where they are not the robot's. loads (T, 17 + 3d): on models with loads.
        """
        found = self.compiled_wall
        wall, slack = (self.compute_local_wall if found is None or not found.ready() else found)(x, numbers, loads)
        # A row a frame, as Chain.with_parameters and the scenarios take them.
        weight = np.full(len(x), self.weight)
        allowed = np.full(len(x), self.contact_threshold)
        return {"wall": wall, "contact_weight": weight, "contact_allowed": allowed}, slack

    def scenario_local_parameters(self, x: Array, numbers: Array, loads: Array | None = None) -> dict[str, Array]:
        """Parameters (T, S, ..) near unknowns x (T, S, n) of robots whose tubes have numbers (S, d, 8), by name.

        loads (T, S, 17 + 3d): on models with loads.
        """
        found = [
            self.local_parameters(x[:, k], own, None if loads is None else loads[:, k])[0]
            for k, own in enumerate(numbers)
        ]
        return {name: np.stack([each[name] for each in found], axis=1) for name in found[0]}

    def compute_local_wall(
        self, x: Array, numbers: Array | None = None, loads: Array | None = None
    ) -> tuple[Array, Array]:
        """Numbers that describe the wall (T, d WALL_SAMPLES_PER_TUBE, COLUMNS), and slacks (T,), without compiled
        code.

        Arguments as in surroundings. Bends sharper than the lumen is wide are noise of the path's points.
        """
        beta = columns_of(self.model.extensions(self.robot, x))
        # Arc lengths over beta_d; a robot that is not out at all has samples at 0.
        sigma = np.hstack(arc_lengths(beta, WALL_SAMPLES_PER_TUBE * self.subsamples)) / np.maximum(
            beta[-1], WALL_MIN_DENOMINATOR
        )
        near = self.lumen.project(self._points(x, sigma, numbers, loads))
        room = (
            near.radius
            - np.repeat(tube_outer_radii(self.robot), WALL_SAMPLES_PER_TUBE * self.subsamples)
            - self.clearance
        )
        # The same rounded distance as in the program (terms.lumen.left), so that both agree on the slack.
        left = room - np.hypot(near.distance, CENTRELINE_SMOOTHING_MM)
        # The room at a place is reduced by what is less between the place before and it: the least of its
        # samples.
        room -= left - np.repeat(left.reshape(len(x), -1, self.subsamples).min(axis=-1), self.subsamples, axis=-1)
        numbers = np.stack([room, near.taper, near.length_before, near.length_after], axis=-1)
        # Curvature of the path at most 1 / r.
        sharpest = (
            1.0 / near.radius / np.maximum(np.linalg.norm(near.curvature_vector, axis=-1), WALL_MIN_DENOMINATOR)
        )
        bend = near.curvature_vector * np.minimum(sharpest, 1.0)[..., None]
        # In the order of terms.lumen.COLUMNS: three vectors, then four numbers.
        wall = np.concatenate([near.centre, near.tangent, bend, numbers], axis=-1)
        # The last sample of each place is the place itself.
        return wall[:, self.subsamples - 1 :: self.subsamples], np.maximum(-left.min(axis=1), 0.0)

    def _points(self, x: Array, sigma: Array, numbers: Array | None, loads: Array | None) -> Array:
        """Points (T, m, 3) in mm of the robot at x and sigma (T, m)."""
        tubes = (self.robot.numbers if numbers is None else numbers)[None]
        if loads is not None:
            return self.model.points_with_loads(loads, self.robot.structure, tubes, x, sigma)
        found: Array = self.model.points_batch(self.robot.structure, tubes, x[None], sigma)[0]
        return found
