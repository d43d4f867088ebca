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

from ctr_nlp.nlp.nlp import Nlp
from ctr_nlp.solvers.frame.adapter import FEASIBLE, OPTIMAL, Ipopt, NlpSolver, Reach, Solution, Surroundings, Timed
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.solvers.frame.run import Run
from ctr_nlp.typing import Array

FALLBACK = "by IPOPT after"
"""Part of the status of a program that was left to IPOPT."""
STATUS = "Solve_Succeeded", "Maximum_Iterations_Exceeded", "Search_Direction_Becomes_Too_Small", "Infeasible_Step"
"""Status texts, in the order of the enum in sqp.c."""


class Sqp(NlpSolver):
    """Solver of one Nlp by SQP; a program that it cannot solve is left to IPOPT, and the status says so."""

    def __init__(self, nlp: Nlp) -> None:
        """Build; raises OptionError where nothing can be compiled."""
        super().__init__(nlp)
        self.program, self._picks, self._own = Program(nlp), nlp.configuration, nlp.row_bounds()
        self._ipopt: Ipopt | None = None
        self._room = Run(self.program, 1, OPTIMAL)

    def __call__(
        self,
        x0: Array,
        p: Array,
        lower: Array | None = None,
        upper: Array | None = None,
        warm: Solution | None = None,
    ) -> Solution:
        """Solve by SQP, and by IPOPT where that fails; arguments as in NlpSolver.__call__."""
        at, n = self.program, len(x0)
        own, picks = self._own, self._picks
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
        success = found.violation <= FEASIBLE and found.kkt <= OPTIMAL
        lam_x, lam_g = np.split(at.multipliers.copy(), [n])
        status, iterations = STATUS[found.status], found.iterations
        q = np.concatenate([x, at.rows[n:]])[self._picks]
        if success:
            return Solution(x, found.objective, found.kkt, True, status, iterations, lam_x, lam_g, q)
        # IPOPT is built only when it is first needed.
        self._ipopt = self._ipopt or Ipopt(self.nlp)
        other = self._ipopt(x0, p, lower, upper, warm)
        return replace(
            other, status=f"{other.status} {FALLBACK} {status}", iterations=other.iterations + iterations
        )

    def follow(
        self,
        x0: Array,
        p: Array,
        reach: Reach,
        here: Array,
        warm: Solution | None,
        near: Surroundings | None = None,
    ) -> list[Timed]:
        """Solve frames one after another in one call of C; arguments as in NlpSolver.follow."""
        run = self._filled(p, reach)
        run.keep_near(near)
        run.here[:], run.program.x[:] = here, x0
        run.program.multipliers[:] = 0.0 if warm is None else np.concatenate([warm.lam_x, warm.lam_g])
        count = run(len(p))
        return [Timed(*each) for each in zip(self._found(count), run.seconds[:count].tolist(), strict=True)]

    def each(self, x0: Array, p: Array, reach: Reach) -> list[Solution]:
        """Solve from every start in one call of C; IPOPT is tried only if no start leads to a solution."""
        # Starts are no frames of a motion: no step is limited.
        far = reach._replace(most=np.full(len(reach.low), np.inf))
        run = self._filled(np.broadcast_to(p, (len(x0), len(p))), far)
        run.keep_near(None)
        run.starts[: len(x0)] = x0
        run(len(x0), from_starts=True)
        found = [each for each, solved in zip(self._found(len(x0)), run.solved, strict=False) if solved]
        return found or super().each(x0, p, reach)

    def _filled(self, p: Array, reach: Reach) -> Run:
        """The arrays of a run, filled with parameters p (frames, n_p) and limits; they grow with the number of
        frames.
        """
        # Room is kept from call to call and only ever grows.
        if len(p) > len(self._room.p):
            self._room = Run(self.program, len(p), OPTIMAL)
        run = self._room
        run.p[: len(p)], run.low[:], run.high[:], run.most[:] = p, *reach
        return run

    def _found(self, count: int) -> list[Solution]:
        """Solutions of the first `count` frames of the last run."""
        run, n = self._room, self._room.x.shape[1]
        x, multipliers, q = run.x[:count].copy(), run.multipliers[:count].copy(), run.rows[:count, self._picks]
        numbers = (each[:count].tolist() for each in (run.objective, run.kkt, run.status, run.iterations))
        return [
            Solution(
                own, objective, kkt, True, STATUS[status], iterations, factors[:n], factors[n:], configuration
            )
            for own, factors, configuration, objective, kkt, status, iterations in zip(
                x, multipliers, q, *numbers, strict=True
            )
        ]
