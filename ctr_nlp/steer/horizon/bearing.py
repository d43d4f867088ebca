"""A motion under a known load: that of the robot without it, solved again over all frames as the robot bears it.

Where the base of a loaded robot points tells its theta, but for a pole at theta_x = 90 deg. So the robot is
solved for as scenarios are, of which it is the only one (formulations/shared/scenarios.py): theta is an unknown
beside the turn of the tip, two equations say that the base points there, and nothing has a pole.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.formulations.settings import Settings
from ctr_nlp.formulations.shared.scenarios import shared_motion
from ctr_nlp.formulations.terms import Term
from ctr_nlp.formulations.wall import wall_of
from ctr_nlp.models import MODELS, Model
from ctr_nlp.models.loaded.model import Loaded
from ctr_nlp.nlp.scenarios import Scenarios, SharedMotion
from ctr_nlp.plan.plan import Plan, plan_from_configurations
from ctr_nlp.simulation.forward import Simulator
from ctr_nlp.solvers.compiled import fastest
from ctr_nlp.solvers.motion.judged import CLOSE, WIDE
from ctr_nlp.solvers.scenarios import SharedSolution, SharedSolver
from ctr_nlp.solvers.scenarios.condensed import Condensed
from ctr_nlp.steer.attempts import Report
from ctr_nlp.steer.horizon.chained import Horizon
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.realised import Missed, held_between, missing
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array


class LoadedHorizon:
    """All frames of a problem of a robot that bears a load, built once and solved for any weight."""

    def __init__(
        self,
        problem: Problem,
        model: Model,
        solver: str | None = None,
        start: npt.ArrayLike | None = None,
        end: npt.ArrayLike | None = None,
        settings: Settings = DEFAULTS,
        terms: Sequence[Term] = (),
    ) -> None:
        """Build; raises as Horizon, and LoadError where the load does not fit the robot.

        Within a wall, the target must not lead the base to the pole of its tilt, or ProblemError is raised.
        """
        assert isinstance(model, Loaded)
        model.check(problem.robot)
        begin = time.perf_counter()
        asked = solver, start, end
        wall = wall_of(problem.robot, problem.sampled_lumen, model, settings)
        self._inside = None if wall is None else Horizon(problem, model, *asked, settings, terms)
        free = replace(settings, contact_weight=0.0)
        self._without = Horizon(problem, MODELS[model.name], *asked, free, terms)
        self._problem, self._model, self._settings, self._terms = problem, model, settings, tuple(terms)
        self._ends, margin = self._without.ends, settings.stability_margin
        self._margins = None if margin is None else np.full(problem.frames, margin)
        self._simulator = Simulator(problem.robot, model)
        self.build_seconds = time.perf_counter() - begin

    def solve(
        self,
        initial: Sequence[npt.ArrayLike] = (),
        motion_weight: float | None = None,
        starts: int | None = None,
        jobs: int = 1,
        progress: Progress | None = None,
        seen: Report | None = None,
        exhaustive: bool = False,
    ) -> Plan:
        """The plan; as solve_horizon."""
        with deferred_interrupt() as interrupted:
            plain = self._without.solve(initial, motion_weight, starts, jobs, progress, seen, exhaustive)
            weight = plain.meta["options"]["motion_weight"]
            begin = time.perf_counter()
            found = None if interrupted() else self._borne(plain.q, weight, interrupted)
            if found is not None and found.success and self._inside is not None and not interrupted():
                return self._inside.solve([found.q], weight, progress=progress)
            stopped = interrupted()
        searched = plain.meta["search_s"] + plain.meta["solve_s"]
        meta = {
            **{key: plain.meta[key] for key in ("formulation", "starts", "contact_weight")},
            **self._model.told,
            "solver": "interior-point",
            "options": plain.meta["options"] | self._settings.options(),
            "build_s": self.build_seconds,
            "search_s": searched,
            "solve_s": time.perf_counter() - begin,
            "iterations": plain.meta["iterations"] + (0 if found is None else found.iterations),
            "interrupted": stopped,
        }
        return self._plan(plain, found, weight, meta)

    def _borne(self, q: Array, weight: float, stop: Callable[[], bool]) -> SharedSolution:
        """The motion under the load, from that without it, q (T, 2d + 2), with margins held between frames too."""
        d, margin = self._problem.robot.d, self._settings.stability_margin
        first = self._from(q, self._motion(weight, self._margins), stop)
        if not first.success:
            return first

        def missed(found: SharedSolution) -> Missed:
            return missing(self._simulator(found.q), found.x, margin, d)

        def again(found: SharedSolution, raised: Array) -> SharedSolution | None:
            solved = SharedSolver(self._motion(weight, raised))(found.q, found.phi, CLOSE, stop)
            return solved if solved.success else None

        made = held_between(first, self._margins, missed, again, stop)
        return first if made is None else made[0]

    def _motion(self, weight: float, margins: Array | None) -> SharedMotion:
        """The program of the robot alone; weight: lambda in s^2; margins (T,): of each frame."""
        problem, robot = self._problem, self._problem.robot
        alone = Scenarios(robot.numbers[None], np.zeros((1, robot.d)), np.ones(1))
        at = robot, problem.samples, problem.dt, weight, self._ends, self._model, alone
        return shared_motion(*at, fastest, margins, self._terms)

    def _from(self, q: Array, motion: SharedMotion, stop: Callable[[], bool]) -> SharedSolution:
        """The first solution that is found from q (T, 2d + 2): where the robot comes to be under the load, which
        is feasible but for margins; where it snaps on the way, from where it is without the load.
        """
        robot, model = self._problem.robot, self._model
        tips = MODELS[model.name].follow(robot, q).x[:, : robot.d]
        bare = model.unloaded(robot, q, np.where(np.isfinite(tips), tips, q[:, : robot.d]))
        borne, solve = self._simulator(q).x, SharedSolver(motion)
        starts = [borne, bare] if np.isfinite(borne).all() else [bare]
        for x, barrier in itertools.product(starts, (CLOSE, WIDE)):
            found = solve(q, x[:, None, motion.own], barrier, stop)
            if found.success or stop():
                break
        return found

    def _plan(self, plain: Plan, found: SharedSolution | None, weight: float, meta: dict[str, Any]) -> Plan:
        """The motion found as a plan; that without the load, not solved, where the search was interrupted."""
        frames, unknown = self._problem.frames, np.full(self._problem.frames, np.nan)
        if found is None:
            why = {"all": "interrupted before the load was looked at"}
            known: dict[str, Any] = {"objective": unknown, "kkt": unknown}
            q, solved, planned = plain.q, False, None
        else:
            condensed = Condensed(self._motion(weight, self._margins))
            condensed.look(found.q, found.phi)
            known = {"objective": condensed.by_frame(found.q, found.phi), "kkt": np.full(frames, found.kkt)}
            why = {} if found.success else {"all": f"{found.status}, KKT residual {found.kkt:.1e}"}
            q, solved, planned = found.q, found.success, found.x
        return plan_from_configurations(
            self._problem,
            q,
            meta | {"failures": why},
            success=np.full(frames, solved),
            solve_time=unknown,
            planned=planned,
            simulator=self._simulator,
            **known,
        )
