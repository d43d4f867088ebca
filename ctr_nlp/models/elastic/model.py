"""The elastic model as a Model: its unknowns are x = (phi, beta, theta) of torsion.py, every x an equilibrium.

Angles in rad, extensions in mm. alpha is a function of x, so that limits and speeds of motors are constraints of
programs; the stability margin is constrained through determinants (stability.py).
"""

from __future__ import annotations

import casadi as ca
import numpy as np

from ctr_nlp.models.dominant.shape import columns_of
from ctr_nlp.models.elastic import shape, stability, torsion
from ctr_nlp.models.elastic.compiled import get_compiled_elastic
from ctr_nlp.models.elastic.following import (
    follow,
    follow_robot_batch,
    solve_rest_batch,
    solve_rest_unknowns,
)
from ctr_nlp.models.elastic.walking import ElasticWalker
from ctr_nlp.models.inner import Inner
from ctr_nlp.models.protocol import (
    STABILITY_SUBSTEPS_PER_FRAME,
    EquilibriumPath,
    Model,
    MotionSubsteps,
    RestStates,
    SampleArcLengths,
    SymbolicShape,
    combination,
    flatten_batch,
    matrix_of,
    vectors_of,
)
from ctr_nlp.models.walker import Walker
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import Structure, Tubes, tubes_of_batch
from ctr_nlp.typing import Array, Vector

ELASTIC_NLP_STEPS_PER_SECTION = 2
"""Steps of integration a section in a nonlinear program: an error of 0.02 mm, where evaluations have 0.002."""


ELASTIC_SHAPES_PER_CHUNK = 64
"""Number of shapes whose samples are computed in one batch: as many as fit into a processor's innermost cache."""


class Elastic(Model):
    """Torsionally compliant tubes (Dupont 2010, Rucker 2010), unloaded and frictionless."""

    name = "elastic"
    several_equilibria = True
    can_snap = True

    def fast(self, structure: Structure) -> bool:
        """Return whether compiled code for this structure is ready.

        The first call begins to compile it in the background.
        """
        return get_compiled_elastic(structure) is not None

    def batches_in_threads(self, structure: Structure) -> bool:
        """Return whether threads may follow robots of a structure: compiled code shares nothing between calls."""
        return self.fast(structure)

    def frame(
        self,
        structure: Structure,
        tubes: Tubes,
        sample_lengths: SampleArcLengths,
        margin: ca.SX | None = None,
        tangents: bool = False,
    ) -> SymbolicShape:
        """Build the shape of one frame in symbols.

        structure, tubes, sample_lengths, margin, tangents: as in Model.frame.
        """
        d = structure.d
        x = ca.SX.sym("x", 2 * structure.d + 2)
        entries = ca.vertsplit(x)
        beta = entries[d : 2 * d]
        parts = torsion.sections(tubes, beta, ca)
        twisted = torsion.twist(tubes, entries, parts, ca, ELASTIC_NLP_STEPS_PER_SECTION)
        lengths, turns = shape.travels(tubes, beta, parts, sample_lengths(beta), ca, ELASTIC_NLP_STEPS_PER_SECTION)
        # Layer by layer: lengths, a row a sample; vectors as columns; the axes; alpha; then determinants and
        # tangents if requested.
        values = [
            ca.horzcat(*lengths),
            matrix_of(shape.curves(tubes, entries, parts, twisted, ca)),
            matrix_of(shape.turned_base(tubes, entries, ca)),
            ca.vertcat(*torsion.motors(tubes, entries, twisted)),
        ]
        # A single tube has no other to be twisted by, and is always stable.
        if margin is not None and d > 1:
            responses = stability.responses(tubes, beta, parts, twisted.nodes, margin, ca)
            values.append(ca.vertcat(*(stability.determinant(response) for response in responses)))
        stable = len(values) > 4
        if tangents:
            values.append(ca.horzcat(*(lengths[0] * 0 + turn for turn in turns)))
        inner = Inner.of(values)
        travelled, directions, axes, alpha, *others = inner.symbols
        vectors = vectors_of(directions)
        first, second, third = vectors_of(axes)
        points = combination(ca.horzsplit(travelled), vectors)
        found = None
        if tangents:
            # The tangent at the base is the third axis, (0, 0, 1); vectors of all sections add their gains.
            found = combination([1.0, *ca.horzsplit(others[-1])], [(0.0, 0.0, 1.0), *vectors])
        # q = (alpha, beta, theta): alpha from the rows after x, beta and theta from x. The tips follow: they
        # identify the branch of equilibria, which q does not.
        picks = (*range(2 * d + 2, 3 * d + 2), *range(d, 2 * d + 2), *range(d))
        margins = others[0] if stable else None
        return SymbolicShape(x, alpha, tuple(beta), points, inner, found, (first, second, third), margins, picks)

    def points(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """Return points (T, n, 3) in mm of a robot at x (T, 2d + 2) and sigma (n,) or (T, n)."""
        return _points(robot.structure, robot.numbers[None], x, sigma)

    def points_batch(self, structure: Structure, numbers: Array, x: Array, sigma: Array) -> Array:
        """Return points (n, T, m, 3) in mm of robots that differ in numbers (n, d, 8), each at x (n, T, 2d + 2).

        structure: what the robots share. sigma: (m,) or (T, m).
        """
        found = _points(structure, *flatten_batch(numbers, x, sigma))
        return found.reshape(*x.shape[:2], *found.shape[1:])

    def rest_states(self, robot: Robot, q: Array, sigma: Array) -> RestStates:
        """Return the equilibria of a robot at rest at each q (T, 2d + 2) without a history.

        sigma (m,): where points are computed.
        """
        return self.rest_batch(robot.structure, robot.numbers[None], q, sigma)

    def rest_batch(
        self, structure: Structure, numbers: Array, q: Array, sigma: Array, threads: int = 1
    ) -> RestStates:
        """Return the equilibria at rest without a history, of robots that differ in numbers (T or 1, d, 8).

        structure: what the robots share. q (T, 2d + 2): a configuration for each. sigma (m,): where points are
        computed. threads: number of threads that share the rows, where code is compiled.
        """
        flat = _flatten_numbers(numbers)
        code = get_compiled_elastic(structure)
        if code is not None:
            return code.rest_states(flat, q, sigma, threads)
        x = solve_rest_batch(structure, numbers, q)
        tubes = tubes_of_batch(structure, numbers)
        ends = shape.backbone(tubes, columns_of(x), np.ones(1), np).tangents
        points = _points(structure, numbers, x, sigma)
        return RestStates(x, points, _stack_components(ends, len(x), 1)[:, 0], stability.margins(tubes, x))

    def tangents(self, robot: Robot, x: Array, sigma: Array) -> Array:
        """Return unit tangents (T, n, 3) of a robot at x (T, 2d + 2) and sigma (n,) or (T, n)."""
        found = shape.backbone(robot.tube_numbers, columns_of(x), sigma, np).tangents
        return _stack_components(found, len(x), np.shape(sigma)[-1])

    def margins(self, robot: Robot, x: Array) -> Array:
        """Return the stability margins (T,) of a robot at x (T, 2d + 2), by Galerkin's method (stability.py)."""
        return stability.margins(robot.tube_numbers, x)

    def rest(self, robot: Robot, q: Array) -> Array:
        """Return the equilibrium of a robot at q (2d + 2,), reached by turning all tubes there from alpha_d.

        NaN where none is found.
        """
        return solve_rest_unknowns(robot, q)

    def guess(self, robot: Robot, q: Array) -> Array:
        """Return the unknowns (.., 2d + 2) of a robot at q (.., 2d + 2) as if its tubes were not twisted."""
        x = np.array(q, dtype=float)
        # A helix's direction turns by its own torsion along its curved part; phi_i is relative to phi_d.
        x[..., : robot.d] += [tube.spin * tube.curved_length for tube in robot.tube_numbers]
        x[..., : robot.d - 1] -= x[..., robot.d - 1 : robot.d]
        return x

    def configuration(self, robot: Robot, x: Array) -> Array:
        """Return the configurations q (T, 2d + 2) of a robot at unknowns x (T, 2d + 2); alpha is explicit in x."""
        tubes = robot.tube_numbers
        columns = columns_of(x)
        d = robot.d
        twisted = torsion.twist(tubes, columns, torsion.sections(tubes, columns[d : 2 * d], np), np)
        return np.hstack([*torsion.motors(tubes, columns, twisted), *columns[d:]])

    def extensions(self, robot: Robot, x: Array) -> Array:
        """Return the extensions beta (T, d) in mm of a robot, which x has in the same columns as q."""
        return x[:, robot.d : 2 * robot.d]

    def follow(
        self, robot: Robot, q: Array, x0: Array | None = None, substeps: int = STABILITY_SUBSTEPS_PER_FRAME
    ) -> EquilibriumPath:
        """Return the equilibria of a robot along a motion through frames q (T, 2d + 2).

        x0 (2d + 2,): its equilibrium in the first frame, None to let it settle there. substeps: between frames.
        See following.follow.
        """
        return follow(robot, q, x0, substeps)

    def walker(self, structure: Structure, numbers: Array, q: Array) -> Walker:
        """Return a robot of numbers (d, 8) at rest at q (2d + 2,), to be moved step by step.

        structure: kinds of its tubes. See walking.ElasticWalker.
        """
        return ElasticWalker(structure, numbers, q)

    def follow_batch(
        self, structure: Structure, numbers: Array, motion: MotionSubsteps, q: Array, margins: bool = True
    ) -> list[EquilibriumPath]:
        """Return the equilibria of robots that differ in numbers (n, d, 8), each at its own q (n, M, 2d + 2).

        structure: what the robots share. motion: which frames the M sub-steps belong to. margins: whether
        stability margins are computed. See following.follow_robot_batch.
        """
        return follow_robot_batch(structure, numbers, motion, q, margins)


def _flatten_numbers(numbers: Array) -> Array:
    """Return numbers (T, d, 8) as rows (T, 8d), number by number, as CasADi and so C lay out a matrix."""
    return np.ascontiguousarray(numbers.swapaxes(1, 2)).reshape(len(numbers), -1)


def _points(structure: Structure, numbers: Array, x: Array, sigma: Array) -> Array:
    """Return points (T, n, 3) in mm of robots of numbers (T or 1, d, 8) at x (T, 2d + 2) and sigma (n,) or
    (T, n).
    """
    if (code := get_compiled_elastic(structure)) is not None:
        return code.shapes(_flatten_numbers(numbers), x, sigma)[0]
    tubes = tubes_of_batch(structure, numbers)
    columns = columns_of(x)
    d = structure.d
    parts = torsion.sections(tubes, columns[d : 2 * d], np)
    vectors = shape.curves(tubes, columns, parts, torsion.twist(tubes, columns, parts, np), np)
    directions, base = (
        np.concatenate([_stack_components(vector, len(x), 1) for vector in some], axis=1)
        for some in (vectors, shape.turned_base(tubes, columns, np))
    )
    # Vectors (T, k, 3) in the robot's axes times these axes: one small product a shape, before samples
    # enter.
    placed = directions @ base
    points = np.empty((len(x), np.shape(sigma)[-1], 3))
    for at in (
        slice(first, first + ELASTIC_SHAPES_PER_CHUNK) for first in range(0, len(x), ELASTIC_SHAPES_PER_CHUNK)
    ):
        own = numbers[at] if len(numbers) > 1 else numbers
        beta = columns_of(x[at, d : 2 * d])
        tubes = tubes_of_batch(structure, own)
        s = (sigma[at] if np.ndim(sigma) > 1 else sigma) * beta[-1]
        lengths, _ = shape.travels(tubes, beta, torsion.sections(tubes, beta, np), s, np)
        travelled = np.empty((len(s), len(lengths), s.shape[1]))
        for k, length in enumerate(lengths):
            travelled[:, k] = length
        points[at] = (placed[at].swapaxes(1, 2) @ travelled).swapaxes(1, 2)
    return points


def _stack_components(vector: Vector, *shape: int) -> Array:
    """x, y and z, broadcast to a shape, as the last axis of one array."""
    return np.stack([np.broadcast_to(part, shape) for part in vector], axis=-1)
