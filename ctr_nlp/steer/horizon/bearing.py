"""A motion under a known load: that of the robot without it, solved again over all frames as the robot bears it.

Where the base of a loaded robot points tells its theta, but for a pole at theta_x = 90 deg. So the robot is
solved for as scenarios are, of which it is the only one (formulations/shared/scenarios.py): theta is an unknown
beside the turn of the tip, two equations say that the base points there, and nothing has a pole.
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
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
from ctr_nlp.steer.attempts import SAME, Report
from ctr_nlp.steer.horizon.chained import Horizon
from ctr_nlp.steer.nlp_frames import DEFAULTS
from ctr_nlp.steer.passes import Progress
from ctr_nlp.steer.realised import SHORT, Missed, held_between, missing
from ctr_nlp.support.interrupt import deferred_interrupt
from ctr_nlp.target.problem import Problem
from ctr_nlp.typing import Array

_Asked = tuple[str | None, npt.ArrayLike | None, npt.ArrayLike | None]
"""The solver's name, and q at the first and the last frame."""
FIRMER = 0.2, 0.1
"""By how much more margin than asked motions without the load have that the search begins with, before the plan.

A motion that keeps just the margin that is asked ends beside the snap, and from there the search under the load
comes to a branch of equilibria that the robot does not reach.
"""
WORTH = 1.1
"""A motion under the load is taken at once where its objective is at most so many times that without the load."""


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
        self._problem, self._model, self._settings, self._terms = problem, model, settings, tuple(terms)
        wall = wall_of(problem.robot, problem.sampled_lumen, model, settings)
        self._inside = None if wall is None else Horizon(problem, model, *asked, settings, terms)
        margin = settings.stability_margin
        self._margins = None if margin is None else np.full(problem.frames, margin)
        self._without = self._unloaded(asked, margin)
        self._ends = self._without.ends
        firmer = () if margin is None else [margin + more for more in FIRMER if margin + more < 1]
        self._firmer = [functools.partial(self._unloaded, asked, more) for more in firmer]
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
            search = functools.partial(Horizon.solve, initial=initial, motion_weight=weight, progress=progress)
            found = None if interrupted() else self._borne(plain, search, interrupted)
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

    def _unloaded(self, asked: _Asked, margin: float | None) -> Horizon:
        """All frames of the robot without the load, and without a wall."""
        free = replace(self._settings, contact_weight=0.0, stability_margin=margin)
        return Horizon(self._problem, MODELS[self._model.name], *asked, free, self._terms)

    def _borne(self, plain: Plan, search: Callable[[Horizon], Plan], stop: Callable[[], bool]) -> SharedSolution:
        """The motion under the load, from plans without it, with margins held between frames too.

        plain: the plan without the load; search: how it was found. The first motion is taken that costs about as
        much as the plan, else the best; where the robot makes none, the first that was solved, else what came of
        the last search.
        """
        weight = plain.meta["options"]["motion_weight"]
        motion, limit = self._motion(weight, self._margins), WORTH * float(plain.objective.sum())
        solved: list[SharedSolution] = []
        made: list[tuple[SharedSolution, float]] = []
        for q in self._starts(plain, search):
            found = self._from(q, motion, stop)
            if stop():
                break
            if not found.success or _known(found, solved):
                continue
            solved.append(found)
            held = self._held(found, weight, stop)
            if held is not None:
                made.append(held)
                if held[1] <= SHORT and held[0].objective <= limit:
                    break
        if made:
            return min(made, key=lambda one: (max(one[1], SHORT), one[0].objective))[0]
        return solved[0] if solved else found

    def _starts(self, plain: Plan, search: Callable[[Horizon], Plan]) -> Iterator[Array]:
        """Motions q (T, 2d + 2) without the load: of more margin first, at last that of the plan itself."""
        for unloaded in self._firmer:
            firmer = search(unloaded())
            if firmer.success.all():
                yield firmer.q
        yield plain.q

    def _held(
        self, first: SharedSolution, weight: float, stop: Callable[[], bool]
    ) -> tuple[SharedSolution, float] | None:
        """The same motion with its margin held between frames, and what the margin is missed by; None where the
        robot does not make it.
        """
        d, margin = self._problem.robot.d, self._settings.stability_margin

        def missed(found: SharedSolution) -> Missed:
            return missing(self._simulator(found.q), found.x, margin, d)

        def again(found: SharedSolution, raised: Array) -> SharedSolution | None:
            solved = SharedSolver(self._motion(weight, raised))(found.q, found.phi, CLOSE, stop)
            return solved if solved.success else None

        return held_between(first, self._margins, missed, again, stop)

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


def _known(found: SharedSolution, solved: Sequence[SharedSolution]) -> bool:
    """Whether another start came to the same solution."""
    return any(abs(found.objective - one.objective) <= SAME * (1 + abs(one.objective)) for one in solved)
