"""Record a motion that is steered live, step by step, and make it a plan."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline

from ctr_nlp.models import Model
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.curve import Curve
from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import sequence
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.typing import Array, Index

FORMULATION = "live"
"""Name of the formulation in a plan's meta."""


class Moment(NamedTuple):
    """One step: q (2d + 2,) to which motors went, target (101, 3) mm, and whether the robot snapped on the way.

    objective (mm^2), kkt and seconds are the solver's; NaN where joints were moved by hand.
    """

    q: Array
    target: Array
    snapped: bool
    objective: float
    kkt: float
    seconds: float


@dataclass
class Recording:
    """Moments, dt s apart, of a problem's robot on a model, steered with settings."""

    problem: Problem
    model: Model
    settings: Settings
    dt: float
    moments: list[Moment] = field(default_factory=list)
    _squares: float = 0.0

    def add(self, moment: Moment, e2: float) -> None:
        """Append a moment with its shape error e2, mm."""
        self.moments.append(moment)
        self._squares += e2**2

    @property
    def e3(self) -> float:
        """Root mean square of e2 over all moments, mm; NaN where there are none."""
        return math.sqrt(self._squares / len(self.moments)) if self.moments else math.nan

    def plan(self) -> Plan:
        """Return the motion as a plan whose frames are the moments, at least one.

        Every frame in which the robot did not snap counts as solved: a motion by hand is no failure of a solver,
        and every step kept limits and speeds.
        """
        columns = [np.array(column) for column in zip(*self.moments, strict=True)]
        q, _, snapped, objective, kkt, seconds = columns
        return plan_from_configurations(
            self._recorded_problem(),
            q,
            self._meta(np.flatnonzero(snapped) + 1),
            success=~snapped,
            solve_time=seconds,
            objective=objective,
            kkt=kkt,
        )

    def _recorded_problem(self) -> Problem:
        """Return the problem with the recorded targets."""
        problem = self.problem
        return Problem(
            f"{problem.name}-live",
            problem.robot,
            sequence([curve_through(moment.target) for moment in self.moments]),
            self.dt * len(self.moments),
            to_robot=problem.to_robot,
            lumen=problem.lumen,
        )

    def _meta(self, snapped: Index) -> dict[str, Any]:
        """Return the plan's meta; snapped: numbers of the frames, from 1, in which the robot snapped."""
        return {
            "formulation": FORMULATION,
            **self.model.metadata,
            "solver": "sqp",
            "options": self.settings.options() | {"direction": None},
            "failures": {str(frame): "the robot snapped on the way" for frame in snapped.tolist()},
            "interrupted": False,
            "contact_weight": None,
        }


def curve_through(points: Array) -> Curve:
    """Return the curve through the points (n, 3), mm, of a target, without a lumen; raises CurveError."""
    along = cumulative_arc_length(points)
    path = CubicSpline(along, points)

    def tangent(s: Array) -> Array:
        slope = path(s, 1)
        return np.asarray(slope / np.linalg.norm(slope, axis=-1, keepdims=True))

    def curvature(s: Array) -> Array:
        slope = path(s, 1)
        bend = path(s, 2)
        # |r' x r''| / |r'|^3: the spline's parameter is the length of its polygon, and so not quite arc length.
        return np.asarray(np.linalg.norm(np.cross(slope, bend), axis=-1) / np.linalg.norm(slope, axis=-1) ** 3)

    return Curve(float(along[-1]), path, tangent, curvature)
