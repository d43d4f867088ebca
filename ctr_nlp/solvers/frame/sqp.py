"""Sequential quadratic programming for one frame, compiled: the whole iteration is in sqp.c.

At x with multipliers lam, the step d minimises d'Hd / 2 + gradient . d subject to the linearised constraints, with
the exact Hessian H of the Lagrangian (mm^2 per squared unit of x). It is found by Goldfarb and Idnani's dual
method (Math. Program. 27, 1983), which needs H positive definite. If it is not, curvature is added along the
normals of active rows, directions in which no step goes while these stay active, and if that is not enough, H gets
the absolute values of its eigenvalues. Steps are shortened until the l1 merit function falls (Nocedal and Wright,
Numerical Optimization, 2006, chapter 18), whose penalties fade (Powell 1978).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ctr_nlp.ocp.local_parameters import LocalParameterSource
from ctr_nlp.ocp.nlp import Nlp
from ctr_nlp.solvers.frame.adapter import (
    FEASIBILITY_TOLERANCE,
    KKT_TOLERANCE,
    ConfigurationLimits,
    Ipopt,
    NlpSolver,
    Solution,
    TimedSolution,
)
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.solvers.frame.run import FrameSequence
from ctr_nlp.typing import Array

IPOPT_FALLBACK_TEXT = "by IPOPT after"
"""Part of the status of a program that was left to IPOPT."""
SQP_STATUS_TEXTS = (
    "Solve_Succeeded",
    "Maximum_Iterations_Exceeded",
    "Search_Direction_Becomes_Too_Small",
    "Infeasible_Step",
)
"""Status texts, in the order of the enum in sqp.c."""


class Sqp(NlpSolver):
    """Solver of one Nlp by SQP; a program that it cannot solve is left to IPOPT, and the status says so."""

    def __init__(self, nlp: Nlp) -> None:
        """Build; raises OptionError where nothing can be compiled."""
        super().__init__(nlp)
        self.program = Program(nlp)
        self._picks = nlp.configuration
        self._own = nlp.row_bounds()
        self._ipopt: Ipopt | None = None
        self._room = FrameSequence(self.program, 1, KKT_TOLERANCE)

    def __call__(
        self,
        x0: Array,
        p: Array,
        lower: Array | None = None,
        upper: Array | None = None,
        warm: Solution | None = None,
    ) -> Solution:
        """Solve by SQP, and by IPOPT where that fails; arguments as in NlpSolver.__call__."""
        at = self.program
        n = len(x0)
        own = self._own
        picks = self._picks
        # Bounds of the configuration stay in the program's arrays from call to call: set them each time.
        at.lower[picks] = own[0][picks] if lower is None else lower
        at.upper[picks] = own[1][picks] if upper is None else upper
        at.p[:] = p
        at.x[:] = np.clip(x0, at.lower[:n], at.upper[:n])
        # Multipliers enter the first Hessian; zero ones leave the constraints' curvature out of it.
        at.multipliers[:] = 0.0 if warm is None else np.concatenate([warm.lam_x, warm.lam_g])
        found = at.run()
        # Iterates keep linear bounds to rounding; a plan must not exceed a motor's limit by that.
        x = np.clip(at.x, at.lower[:n], at.upper[:n])
        # By the problem's own residuals, not by the reason for which the iteration ended.
        success = found.violation <= FEASIBILITY_TOLERANCE and found.kkt <= KKT_TOLERANCE
        lam_x, lam_g = np.split(at.multipliers.copy(), [n])
        status = SQP_STATUS_TEXTS[found.status]
        iterations = found.iterations
        q = np.concatenate([x, at.rows[n:]])[self._picks]
        if success:
            return Solution(x, found.objective, found.kkt, True, status, iterations, lam_x, lam_g, q)
        # IPOPT is built only when it is first needed.
        self._ipopt = self._ipopt or Ipopt(self.nlp)
        other = self._ipopt(x0, p, lower, upper, warm)
        return replace(
            other,
            status=f"{other.status} {IPOPT_FALLBACK_TEXT} {status}",
            iterations=other.iterations + iterations,
        )

    def solve_sequence(
        self,
        x0: Array,
        p: Array,
        reach: ConfigurationLimits,
        here: Array,
        warm: Solution | None,
        local_parameters: LocalParameterSource | None = None,
    ) -> list[TimedSolution]:
        """Solve frames one after another in one call of C.

        x0, p, reach, here, warm, local_parameters: as in NlpSolver.solve_sequence.
        """
        run = self._fill_sequence(p, reach)
        run.set_local_parameters(local_parameters)
        run.here[:], run.program.x[:] = here, x0
        run.program.multipliers[:] = 0.0 if warm is None else np.concatenate([warm.lam_x, warm.lam_g])
        count = run(len(p))
        return [
            TimedSolution(*each)
            for each in zip(self._collect_solutions(count), run.seconds[:count].tolist(), strict=True)
        ]

    def solve_from_starts(self, x0: Array, p: Array, reach: ConfigurationLimits) -> list[Solution]:
        """Solve from every start in one call of C; IPOPT is tried only if no start leads to a solution.

        x0 (starts, n): the starts. p (n_p,): packed parameters. reach: limits of the configuration.
        """
        # Starts are no frames of a motion: no step is limited.
        far = reach._replace(most=np.full(len(reach.low), np.inf))
        run = self._fill_sequence(np.broadcast_to(p, (len(x0), len(p))), far)
        run.set_local_parameters(None)
        run.starts[: len(x0)] = x0
        run(len(x0), from_starts=True)
        found = [
            each for each, solved in zip(self._collect_solutions(len(x0)), run.solved, strict=False) if solved
        ]
        return found or super().solve_from_starts(x0, p, reach)

    def _fill_sequence(self, p: Array, reach: ConfigurationLimits) -> FrameSequence:
        """Return the arrays of a run, filled with parameters p (frames, n_p) and limits.

        They grow with the number of frames.
        """
        # Room is kept from call to call and only ever grows.
        if len(p) > len(self._room.p):
            self._room = FrameSequence(self.program, len(p), KKT_TOLERANCE)
        run = self._room
        run.p[: len(p)], run.low[:], run.high[:], run.most[:] = p, *reach
        return run

    def _collect_solutions(self, count: int) -> list[Solution]:
        """Return the solutions of the first `count` frames of the last run."""
        run = self._room
        n = self._room.x.shape[1]
        x = run.x[:count].copy()
        multipliers = run.multipliers[:count].copy()
        q = run.rows[:count, self._picks]
        numbers = (each[:count].tolist() for each in (run.objective, run.kkt, run.status, run.iterations))
        return [
            Solution(
                own,
                objective,
                kkt,
                True,
                SQP_STATUS_TEXTS[status],
                iterations,
                factors[:n],
                factors[n:],
                configuration,
            )
            for own, factors, configuration, objective, kkt, status, iterations in zip(
                x, multipliers, q, *numbers, strict=True
            )
        ]
