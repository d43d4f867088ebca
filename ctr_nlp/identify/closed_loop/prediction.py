"""Predicted shape of a robot at given points, and its slopes over motors, tubes and a tip force, as compiled code.

Slopes are total derivatives, models/implicit_derivatives.py. The stability margin mu is implicit, D(mu, x, p) = 0
for the determinant D of the shifted second variation, so that its slopes are -D_x / D_mu and -D_p / D_mu.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.codegen.batch_evaluator import BatchEvaluator
from ctr_nlp.codegen.vector import SHARED_INPUT_PREFIX, VECTOR_LANES
from ctr_nlp.identify.closed_loop.compilation import compile_function
from ctr_nlp.models import Model
from ctr_nlp.models.implicit_derivatives import make_total_derivative
from ctr_nlp.models.protocol import frame_and_load_symbol, symbolic_tubes
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure
from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.typing import Array

TUBE_PARTS = DEVIATION_NAMES[:-1]
"""Names in DEVIATION_NAMES that change numbers of tubes; the last one is the motor's zero, which changes alpha."""

MAX_LINEARISATION_MARGIN = 1 - 1e-4
"""Largest margin at which slopes are computed: at 1, where tubes do not act on each other, the slope of the
determinant is 0, and close to it under a load it is mere rounding."""

NUMBERS_CHANGED_BY_PART = {
    "curvature": ("root_curvature", "tip_curvature"),
    "bending_stiffness": ("bending_stiffness",),
    "torsional_ratio": ("torsional_ratio",),
    "curved_length": ("curved_length",),
}
"""Numbers of a tube that each part changes: in proportion to the nominal number, except for the length."""


class PredictedShape(NamedTuple):
    """A shape at n points, and its slopes over alpha, beta, theta, parts of tubes and the tip force (N), k in all.

    points (n, 3): in mm. tangents (n, 3): unit vectors. of_points, of_tangents (k, n, 3): their slopes. of_phi
    (k, d): slopes of the tips' angles. of_margin (k,): slopes of the margin, NaN where nothing can be unstable.
    """

    points: Array
    tangents: Array
    of_points: Array
    of_tangents: Array
    of_phi: Array
    of_margin: Array


class Predictor:
    """Evaluates PredictedShape for robots of a structure; each call overwrites the arrays of the one before."""

    def __init__(
        self,
        model: Model,
        structure: Structure,
        sigma: Array,
        tube_parts: tuple[tuple[int, str], ...],
        has_tip_force: bool = False,
    ) -> None:
        """Compile, where that can be done, and wait for it.

        model, structure: of the robots. sigma: (n,), points of the shape. tube_parts: tubes, from 0, and their
        parts, of TUBE_PARTS, over which slopes are wanted. has_tip_force: whether slopes over a force at the tip
        are wanted, too, on a model with loads.
        """
        each = -(-len(sigma) // VECTOR_LANES)
        self._call = BatchEvaluator(_code(model.program_model, structure, each, tube_parts, has_tip_force), 1)
        self._call.inputs[1][0] = np.append(sigma, np.zeros(VECTOR_LANES * each - len(sigma)))
        self._d = structure.d
        self._n = len(sigma)
        self._k = 2 * structure.d + 2 + len(tube_parts) + 3 * has_tip_force

    def __call__(self, x: Array, numbers: Array, described: Array, margin: float, load: Array) -> PredictedShape:
        """Return the shape and its slopes at an equilibrium x (n_x,).

        numbers: (d, 8) of the tubes. described: (d, 8) of the nominal tubes, in parts of which slopes are. margin:
        at the equilibrium. load: its numbers, empty without a load.
        """
        given = np.concatenate(
            [numbers.ravel("F"), described.ravel("F"), [min(margin, MAX_LINEARISATION_MARGIN)], load]
        )
        points, tangents, of_points, of_tangents, of_phi, of_margin = (each[0] for each in self._call(x, given))
        d = self._d
        k = self._k
        return PredictedShape(
            points.reshape(-1, 3)[: self._n],
            tangents.reshape(-1, 3)[: self._n],
            self._slopes(of_points),
            self._slopes(of_tangents),
            of_phi[: k * d].reshape(k, d),
            of_margin[:k],
        )

    def _slopes(self, by_lane: Array) -> Array:
        """Return the slopes (k, n, 3) at all points, from those that each lane computed."""
        found = by_lane.reshape(VECTOR_LANES, self._k, -1, 3).transpose(1, 0, 2, 3)
        return found.reshape(self._k, -1, 3)[:, : self._n]


@functools.lru_cache(maxsize=16)
def _code(
    model: Model, structure: Structure, count: int, tube_parts: tuple[tuple[int, str], ...], has_tip_force: bool
) -> ca.Function:
    """Return the compiled function of a Predictor, for `count` points in each of several lanes."""
    return compile_function(_symbolic(model, structure, count, tube_parts, has_tip_force), VECTOR_LANES)


def _symbolic(
    model: Model, structure: Structure, count: int, tube_parts: tuple[tuple[int, str], ...], has_tip_force: bool
) -> ca.Function:
    """Build (x, sigma (count,), (numbers (d, 8), described (d, 8), margin, load)) -> PredictedShape's columns."""
    d = structure.d
    sigma = ca.SX.sym("sigma", count)
    margin = ca.SX.sym("margin")
    numbers, described = (ca.SX.sym(name, d, len(TUBE_NUMBER_NAMES)) for name in ("numbers", "described"))
    parts = ca.SX.sym("parts", len(tube_parts))
    tubes = symbolic_tubes(structure, _perturbed_numbers(numbers, described, parts, tube_parts))
    asked = margin if model.can_snap else None
    shape, load = frame_and_load_symbol(
        model, structure, tubes, lambda beta: sigma * beta[-1], asked, tangents=True
    )
    assert shape.tangents is not None
    determinant = ca.SX(0) if shape.stability is None else shape.stability[-1]
    points, tangents = (
        ca.vec(ca.vertcat(*(ca.SX(axis).T for axis in shape.to_base_frame(of))))
        for of in (shape.points, shape.tangents)
    )
    symbols, values = shape.inner.columns
    written = [ca.vertcat(points, tangents), ca.vertcat(*shape.rows.values()), determinant]
    seen, rows, determinant = ca.substitute(written, [symbols], [values])
    moved = make_total_derivative(shape, rows, ca.vertcat(parts, load[: 3 * has_tip_force]))
    slope = ca.SX.nan(1) if shape.stability is None else -ca.jacobian(determinant, margin)
    of_points, of_tangents = ca.vertsplit(moved(seen), 3 * count)
    of_phi = moved(shape.x[:d])
    of_margin = moved(determinant) / slope
    found = [*ca.vertsplit(seen, 3 * count), of_points, of_tangents, of_phi, of_margin]
    found = ca.substitute(found, [parts], [ca.SX.zeros(len(tube_parts))])
    given = ca.vertcat(ca.vec(numbers), ca.vec(described), margin, load)
    names = (
        [f"{SHARED_INPUT_PREFIX}x", "sigma", f"{SHARED_INPUT_PREFIX}given"],
        [f"found_{k}" for k in range(len(found))],
    )
    return ca.Function("predicted", [shape.x, sigma, given], [ca.densify(each) for each in found], *names)


def _perturbed_numbers(
    numbers: ca.SX, described: ca.SX, parts: ca.SX, tube_parts: tuple[tuple[int, str], ...]
) -> ca.SX:
    """Return numbers (d, 8) plus parts of the nominal ones, `described`, as in robot/samples.py; lengths in mm."""
    found = ca.SX(numbers)
    for k, (tube, name) in enumerate(tube_parts):
        for column in (TUBE_NUMBER_NAMES.index(each) for each in NUMBERS_CHANGED_BY_PART[name]):
            scale = 1.0 if name == "curved_length" else described[tube, column]
            found[tube, column] += parts[k] * scale
    return found
