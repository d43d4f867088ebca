"""Sequential quadratic programming for one frame, compiled: the whole iteration is C.

Hessians are exact. A step is the solution of a quadratic problem by Goldfarb and Idnani's dual method (Math.
Program. 27, 1983); where the Hessian is not positive definite, curvature is added across the rows that are active
and, where that is not enough, the eigenvalues lose their signs. Steps are shortened until the l1 merit function
falls (Nocedal and Wright, Numerical Optimization, 2006, chapter 18).
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
"""In the status of what was left to IPOPT."""
STATUS = "Solve_Succeeded", "Maximum_Iterations_Exceeded", "Search_Direction_Becomes_Too_Small", "Infeasible_Step"


class Sqp(NlpSolver):
    """Solves one Nlp; what it cannot solve is left to IPOPT, and the status says so."""

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
        """As NlpSolver."""
        at, n = self.program, len(x0)
        own, picks = self._own, self._picks
        at.lower[picks] = own[0][picks] if lower is None else lower
        at.upper[picks] = own[1][picks] if upper is None else upper
        at.p[:] = p
        at.x[:] = np.clip(x0, at.lower[:n], at.upper[:n])
        at.multipliers[:] = 0.0 if warm is None else np.concatenate([warm.lam_x, warm.lam_g])
        found = at.run()
        x = np.clip(at.x, at.lower[:n], at.upper[:n])
        success = found.violation <= FEASIBLE and found.kkt <= OPTIMAL
        lam_x, lam_g = np.split(at.multipliers.copy(), [n])
        status, iterations = STATUS[found.status], found.iterations
        q = np.concatenate([x, at.rows[n:]])[self._picks]
        if success:
            return Solution(x, found.objective, found.kkt, True, status, iterations, lam_x, lam_g, q)
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
        """As NlpSolver, in one call."""
        run = self._filled(p, reach)
        run.keep_near(near)
        run.here[:], run.program.x[:] = here, x0
        run.program.multipliers[:] = 0.0 if warm is None else np.concatenate([warm.lam_x, warm.lam_g])
        return [Timed(self._found(k), float(run.seconds[k])) for k in range(run(len(p)))]

    def each(self, x0: Array, p: Array, reach: Reach) -> list[Solution]:
        """As NlpSolver, in one call; IPOPT is asked only where nothing else is found."""
        far = reach._replace(most=np.full(len(reach.low), np.inf))
        run = self._filled(np.broadcast_to(p, (len(x0), len(p))), far)
        run.keep_near(None)
        run.starts[: len(x0)] = x0
        run(len(x0), from_starts=True)
        return [self._found(k) for k in range(len(x0)) if run.solved[k]] or super().each(x0, p, reach)

    def _filled(self, p: Array, reach: Reach) -> Run:
        """Room for parameters p (frames, n_p), filled with these and limits."""
        if len(p) > len(self._room.p):
            self._room = Run(self.program, len(p), OPTIMAL)
        run = self._room
        run.p[: len(p)], run.low[:], run.high[:], run.most[:] = p, *reach
        return run

    def _found(self, k: int) -> Solution:
        """What the last run found of a frame."""
        run, n = self._room, self._room.x.shape[1]
        multipliers, q = run.multipliers[k].copy(), run.rows[k][self._picks]
        lam_x, lam_g = multipliers[:n], multipliers[n:]
        numbers = float(run.objective[k]), float(run.kkt[k]), True, STATUS[run.status[k]], int(run.iterations[k])
        return Solution(run.x[k].copy(), *numbers, lam_x, lam_g, q)
