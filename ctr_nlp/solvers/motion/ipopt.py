"""Chains solved by IPOPT, with the same exact derivatives as every other solver of chains.

The program is that of ocp/chain.py, with objective in mm^2 and unknowns in rad and mm. The gradient, Jacobian and
Hessian of the whole are put together from the frames' blocks and the links' constant matrix, instead of being
derived by CasADi from the whole expression. IPOPT: Waechter and Biegler, Math. Program. 106 (2006).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np
import scipy.sparse as sp

from ctr_nlp.ocp.chain import Chain
from ctr_nlp.solvers.frame.adapter import CASADI_SOLVER_OPTIONS, Solution, status_and_iterations
from ctr_nlp.solvers.motion.chain_solution import COLD_START_BARRIER_MM2, evaluate_chain_solution
from ctr_nlp.solvers.motion.watch import Iterate, Watch
from ctr_nlp.typing import Array

CHAIN_IPOPT_OPTIONS: dict[str, Any] = {
    "sb": "yes",
    "print_level": 0,
    "max_iter": 500,
    "tol": 1e-6,
    "bound_relax_factor": 1e-10,
}
"""Options of IPOPT; bounds are relaxed by 1e-10 only, since motors have hard limits."""


class IpoptSolver:
    """Solver of any chain, from any start, feasible or not."""

    def __init__(self, chain: Chain, report_iterates: bool = True) -> None:
        """Build for a chain.

        report_iterates: whether the Watch is called with every iterate; without it the time of reporting is saved.
        """
        self.chain = chain
        self._callback = _Callback(chain)
        # no_nlp_grad: the gradient of the whole Lagrangian is a function that nothing here calls.
        self._options = CASADI_SOLVER_OPTIONS | _derivatives(chain) | {"no_nlp_grad": True}
        if report_iterates:
            self._options["iteration_callback"] = self._callback
        self._built: dict[float, ca.Function] = {}

    def _solver(self, barrier: float) -> ca.Function:
        """Return the IPOPT instance that starts with a barrier, mm^2; built once for each."""
        if barrier not in self._built:
            options = self._options | {"ipopt": CHAIN_IPOPT_OPTIONS | {"mu_init": barrier}}
            self._built[barrier] = ca.nlpsol("ipopt", "ipopt", _problem(self.chain), options)
        return self._built[barrier]

    def __call__(
        self,
        x0: Array,
        watch: Watch,
        barrier: float = COLD_START_BARRIER_MM2,
        multipliers: Array | None = None,
        tolerance: float | None = None,
    ) -> Solution:
        """Solve from x0 (T n,); IPOPT starts with multipliers of its own, and `multipliers` is ignored.

        watch: reported every iterate. barrier: the first one, mm^2. tolerance: ignored, as IPOPT solves exactly.
        """
        chain = self.chain
        size = x0.size
        low, high = chain.bounds
        self._callback.set_watch(watch)
        # A start within its bounds; fixed unknowns take their values.
        x0 = np.clip(x0, low[:size], high[:size])
        solve = self._solver(barrier)
        # Rows that only fixed unknowns enter are constants: rounding may put them outside their bounds.
        lbg = np.where(chain.changeable_rows, low, -np.inf)[size:]
        ubg = np.where(chain.changeable_rows, high, np.inf)[size:]
        result = solve(x0=x0, lbx=low[:size], ubx=high[:size], lbg=lbg, ubg=ubg)
        x, lam_x, lam_g = (result[key].full().ravel() for key in ("x", "lam_x", "lam_g"))
        # Off the relaxed bounds, before the point is judged.
        x = np.clip(x, low[:size], high[:size])
        return evaluate_chain_solution(chain, x, np.concatenate([lam_x, lam_g]), *status_and_iterations(solve))


class _Callback(ca.Callback):
    """Hands every iterate of IPOPT to a Watch. CasADi keeps no reference to it, so the solver must."""

    def __init__(self, chain: Chain) -> None:
        super().__init__()
        self._chain = chain
        self.watch = Watch()
        self.number = 0
        self.construct("iteration", {})

    def set_watch(self, watch: Watch) -> None:
        """Hand iterates to another Watch, counted from 0."""
        self.watch = watch
        self.number = 0

    def get_n_in(self) -> int:
        """Return the number of inputs: all outputs of an NLP solver."""
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        """Return the number of outputs: one, whether to stop."""
        return 1

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        """Return the shape of an input; inputs that CasADi does not report are empty."""
        rows = self._chain.lower.size
        g = self._chain.bounds[0].size - rows
        return ca.Sparsity.dense({"x": rows, "lam_x": rows, "f": 1, "g": g, "lam_g": g}.get(ca.nlpsol_out(i), 0))

    def eval(self, values: Sequence[ca.DM]) -> list[float]:
        """Report an iterate; a result other than 0 stops IPOPT."""
        found = dict(zip(ca.nlpsol_out(), values, strict=True))
        x, g, lam_x, lam_g = (found[key].full().ravel() for key in ("x", "g", "lam_x", "lam_g"))
        violation = self._chain.violation(np.concatenate([x, g]))
        error = float(self._chain.kkt(x, np.concatenate([lam_x, lam_g])).max())
        stop = self.watch(Iterate(self.number, float(found["f"]), violation, error, x))
        self.number += 1
        return [float(stop)]


def _problem(chain: Chain) -> dict[str, ca.MX]:
    """Return the chain as nlpsol takes it, in matrix symbols."""
    x = ca.MX.sym("x", chain.lower.size)
    f, g = _values(chain, x)
    return {"x": x, "f": f, "g": g}


def _map_frames(chain: Chain, function: ca.Function, *columns: ca.MX) -> list[ca.MX]:
    """Evaluate a function of a frame for all frames; arguments have one column a frame."""
    lanes = chain.functions().lanes
    # Compiled functions take `lanes` frames a call. The last call is filled up with copies of the last
    # frame, whose results are cut off again.
    calls = -(-chain.frames // lanes)
    more = calls * lanes - chain.frames
    filled = (ca.horzcat(each, ca.repmat(each[:, -1], 1, more)) for each in columns)
    found = function.map(calls)(*filled)
    return [each[:, : each.shape[1] // (calls * lanes) * chain.frames] for each in found]


def _columns(chain: Chain, x: ca.MX) -> ca.MX:
    """Return the unknowns x (T n,) as a matrix (n, T), a column a frame."""
    return ca.reshape(x, chain.unknowns, chain.frames)


def _values(chain: Chain, x: ca.MX) -> tuple[ca.MX, ca.MX]:
    """Return objective and rows after x of the whole chain: the frames' constraints, then the links."""
    f, g = _map_frames(chain, chain.functions().value, _columns(chain, x), ca.MX(chain.parameters))
    own = ca.vertcat(x, ca.vec(g))
    linked = _to_casadi_matrix(chain.linking) @ own + ca.DM(chain.offset)
    return ca.sum2(f) + ca.dot(ca.DM(chain.weight), linked**2), ca.vertcat(ca.vec(g), linked)


def _derivatives(chain: Chain) -> dict[str, ca.Function]:
    """Return functions for gradient, Jacobian and Hessian, with the names and arguments that nlpsol asks for."""
    x = ca.MX.sym("x", chain.lower.size)
    p = ca.MX.sym("p", 0, 0)
    lam_f = ca.MX.sym("lam_f")
    lam_g = ca.MX.sym("lam_g", chain.bounds[0].size - chain.lower.size)
    frames = chain.frames
    n = chain.unknowns
    m = chain.frame.g.numel()
    # d(w a^2) = 2 w a da, so the weights come with a factor 2 everywhere below.
    weight = 2 * ca.DM(chain.weight)
    end = frames * m
    f, g = _values(chain, x)
    at = _columns(chain, x), ca.MX(chain.parameters)
    _, gradient, _, jacobian = _map_frames(chain, chain.functions().slopes, *at)
    jacobian = _block_diagonal(jacobian, m, n, frames)
    # The links' matrix acts on x directly and on the frames' constraints g; through these it depends on x
    # by their Jacobian.
    on_x, on_g = ca.horzsplit(_to_casadi_matrix(chain.linking), [0, chain.lower.size, chain.linking.shape[1]])
    links = on_x + on_g @ jacobian if chain.has_nonlinear_links else on_x
    gradient = ca.vec(gradient) + links.T @ (weight * g[end:])
    # Multipliers of g: its own, and what links pull with, their multipliers and their costs' slopes. With
    # these, the frames' Hessians include the curvature of links that pass through constraints.
    pulled = lam_g[:end] + on_g.T @ (lam_g[end:] + lam_f * weight * g[end:])
    lam = ca.repmat(lam_f, 1, frames), ca.reshape(pulled, m, frames)
    *_, hessian = _map_frames(chain, chain.functions().expansion, *at, *lam)
    # The links' costs add 2 w B'B, with B their Jacobian; IPOPT reads the upper triangle only.
    hessian = ca.triu(_block_diagonal(hessian, n, n, frames) + lam_f * (links.T @ ca.diag(weight) @ links))
    jacobian = ca.vertcat(jacobian, links)
    return {
        "grad_f": ca.Function("nlp_grad_f", [x, p], [f, gradient], ["x", "p"], ["f", "grad_f_x"]),
        "jac_g": ca.Function("nlp_jac_g", [x, p], [g, jacobian], ["x", "p"], ["g", "jac_g_x"]),
        "hess_lag": ca.Function(
            "nlp_hess_l",
            [x, p, lam_f, lam_g],
            [hessian],
            ["x", "p", "lam_f", "lam_g"],
            ["triu_hess_gamma_x_x"],
        ),
    }


def _to_casadi_matrix(matrix: Any) -> ca.DM:
    """Return a scipy matrix as a sparse CasADi matrix, which is stored by columns with sorted rows."""
    columns = sp.csc_matrix(matrix)
    columns.sort_indices()
    return ca.DM(columns)


def _block_diagonal(blocks: ca.MX, rows: int, columns: int, frames: int) -> ca.MX:
    """Return dense blocks side by side (rows, columns * frames) as the blocks of a block-diagonal matrix."""
    pattern = ca.diagcat(*[ca.Sparsity.dense(rows, columns)] * frames)
    # Both store entries column by column, so the nonzeros are the same numbers in the same order.
    return ca.MX(pattern, ca.vec(blocks))
