"""A lumen's wall as programs see it: at sample points along the robot, linearised near its configuration.

The visible part of every tube has terms.lumen.WALL_SAMPLES_PER_TUBE sample points, each with the lumen's path
nearby to second order and the wall's radius to first order. So have subsamples beside each, which are taken to
move as the sample point does. This is valid near a configuration only: the wall is linearised again at a
solution, and the program solved again, until nothing changes. Clearance is r(p) - |C - p| - rho in mm, with the
radius r at the path's nearest point p and the outer radius rho of the outermost tube (docs/method.md, "The lumen's
wall").
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
from ctr_nlp.ocp.terms.lumen import (
    CENTRELINE_SMOOTHING_MM,
    WALL_COLUMN_COUNT,
    WALL_SAMPLES_PER_TUBE,
    WALL_SUBSAMPLES,
    arc_lengths,
    contact_penalty,
)
from ctr_nlp.paths.lumen import tube_outer_radii
from ctr_nlp.paths.target import Frame
from ctr_nlp.paths.walls import WallGeometry
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Index

MAX_WALL_RELINEARISATIONS = 12
"""Most times that a program is solved around its own solution."""
WALL_SLACK_TOLERANCE_MM = 0.005
"""Difference in mm up to which the slack of a solution agrees with the slack needed there."""
PLANNED_CONTACT_FRACTION = 0.6
"""Fraction of the allowed contact beyond which it costs more in planning: penalties yield a little, and programs
check the wall at fewer points than the verdict does.
"""
WALL_MIN_DENOMINATOR = 1e-9
"""Replaces 0 in denominators, mm and 1/mm."""


def make_wall(
    robot: Robot,
    geometry: WallGeometry | None,
    model: Model,
    settings: Settings,
    subsamples: int = WALL_SUBSAMPLES,
) -> Wall | None:
    """Return the wall around a robot on a model; None without a geometry, or where contact costs nothing.

    settings: weight, clearance and allowed contact. subsamples: for each sample point, see Wall.
    """
    if geometry is None or not settings.contact_weight:
        return None
    return Wall(
        robot, geometry, model, settings.contact_weight, settings.clearance, settings.contact_allowed, subsamples
    )


@dataclass(frozen=True)
class Wall:
    """The wall of a lumen around a robot on a model.

    weight: cost of a mm of contact, mm^2. clearance: least distance from the wall, mm. contact_allowed: mm beyond
    the wall from which contact costs more. subsamples: for each sample point, between it and the one before.
    """

    robot: Robot
    geometry: WallGeometry
    model: Model
    weight: float
    clearance: float
    contact_allowed: float = math.inf
    subsamples: int = WALL_SUBSAMPLES

    def cost(self, slack: Array) -> Array:
        """Return the costs, mm^2, of a slack in mm, entry by entry, as terms.lumen.contact_penalty."""
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
            self.robot, self.geometry, self.model, self.clearance, self.subsamples, WALL_MIN_DENOMINATOR
        )

    def __getstate__(self) -> dict[str, Any]:
        # Cached objects of C cannot be pickled; another process finds its own.
        return {each.name: getattr(self, each.name) for each in fields(self)}

    def local_parameters_during(
        self, frames: Sequence[Frame]
    ) -> Callable[[Array], tuple[dict[str, Array], Array]]:
        """Return a function that maps unknowns x (T, n) in these frames to their local parameters.

        Loads that change over time are those of the frames' times.
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
        """Return parameters (T, ..) linearised at unknowns x (T, n), by name, and slacks (T,) needed, mm.

        numbers (d, 8): of the tubes, where they are not the robot's. loads (T, 17 + 3d): on models with loads.
        """
        found = self.compiled_wall
        wall, slack = (self.compute_local_wall if found is None or not found.ready() else found)(x, numbers, loads)
        # A row a frame, as Chain.with_parameters and the scenarios take them.
        # The weight is a parameter of programs, too: it is raised without compiling anew.
        weight = np.full(len(x), self.weight)
        allowed = np.full(len(x), self.contact_threshold)
        return {"wall": wall, "contact_weight": weight, "contact_allowed": allowed}, slack

    def scenario_local_parameters(self, x: Array, numbers: Array, loads: Array | None = None) -> dict[str, Array]:
        """Return parameters (T, S, ..) linearised at the unknowns x (T, S, n) of S robots, by name.

        numbers (S, d, 8): of their tubes. loads (T, S, 17 + 3d): on models with loads.
        """
        found = [
            self.local_parameters(x[:, k], own, None if loads is None else loads[:, k])[0]
            for k, own in enumerate(numbers)
        ]
        return {name: np.stack([each[name] for each in found], axis=1) for name in found[0]}

    def compute_local_wall(
        self, x: Array, numbers: Array | None = None, loads: Array | None = None
    ) -> tuple[Array, Array]:
        """Return the wall's numbers near x (T, n), and the slacks (T,) needed, without compiled code.

        The first are (T, rows, WALL_COLUMN_COUNT): the first subsample of every sample point, then the second of
        every one. numbers (d, 8), loads (T, 17 + 3d): as in local_parameters.
        """
        beta = columns_of(self.model.extensions(self.robot, x))
        # Arc lengths over beta_d; a robot that is not out at all has samples at 0.
        sigma = np.hstack(arc_lengths(beta, WALL_SAMPLES_PER_TUBE * self.subsamples)) / np.maximum(
            beta[-1], WALL_MIN_DENOMINATOR
        )
        points = self._points(x, sigma, numbers, loads)
        near = self.geometry.project(points)
        outer = np.repeat(tube_outer_radii(self.robot), WALL_SAMPLES_PER_TUBE * self.subsamples)
        room = near.room_on_path - outer - self.clearance
        # The same rounded distance as in the program (terms.lumen.room_beside_path), so that both agree on the
        # slack.
        left = room - near.slope * np.hypot(near.distance, CENTRELINE_SMOOTHING_MM)
        # What the program sees of a wall: the path to second order, the radius to first.
        numbers = np.stack([room, near.taper, near.length_before, near.length_after, near.slope], axis=-1)
        # In the order of terms.lumen.WALL_COLUMN_COUNT: three vectors, then five numbers.
        wall = np.concatenate([near.centre, near.tangent, near.bend, numbers], axis=-1)
        slack = np.maximum(-left.min(axis=1), 0.0)
        # Programs know how a sample point p moves, and not the places s beside it: these are taken to move as the
        # point does. Room at s is then that at p beside a wall whose centre is moved by p - s. Derivatives of
        # points over the unknowns are what takes time in programs; these rows need none but those of p.
        at_samples, beside = self._subsamples
        found = wall[:, beside]
        found[..., :3] += points[:, at_samples] - points[:, beside]
        return found.reshape(len(x), -1, WALL_COLUMN_COUNT), slack

    @cached_property
    def _subsamples(self) -> tuple[Index, Index]:
        """Positions of the sample points among all places, (1, samples), and of their subsamples, (subsamples,
        samples).

        Subsamples are those around a sample point, or at a tube's tip those before it.
        """
        samples = np.arange(self.robot.d * WALL_SAMPLES_PER_TUBE)
        at_samples = (samples + 1) * self.subsamples - 1
        is_tip = (samples + 1) % WALL_SAMPLES_PER_TUBE == 0
        first = at_samples - np.where(is_tip, self.subsamples - 1, self.subsamples // 2)
        return at_samples[None], first + np.arange(self.subsamples)[:, None]

    def _points(self, x: Array, sigma: Array, numbers: Array | None, loads: Array | None) -> Array:
        """Return points (T, m, 3) in mm of the robot at x and sigma (T, m)."""
        tubes = (self.robot.numbers if numbers is None else numbers)[None]
        if loads is not None:
            return self.model.points_with_loads(loads, self.robot.structure, tubes, x, sigma)
        found: Array = self.model.points_batch(self.robot.structure, tubes, x[None], sigma)[0]
        return found
