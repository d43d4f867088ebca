"""A frame's program from a model and terms, built once for robots that differ in numbers alone.

Unknowns are the model's x (rad, mm), then free numbers of tubes, then slacks. Constraints begin with the part of
the configuration q, eq. (5), that x does not contain, then those of the terms. Numbers of tubes, targets and
weights are parameters: a program is found again by its structure, model and terms.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Hashable, Mapping, Sequence
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import Model, SymbolicShape
from ctr_nlp.models.protocol import symbolic_tubes
from ctr_nlp.ocp.nlp import Constraint, Nlp
from ctr_nlp.ocp.terms import Body, LoadTerm, Margin, Parts, Term
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, Structure, locate_free_numbers
from ctr_nlp.typing import Array

MAX_CACHED_FRAME_PROGRAMS = 64
"""Number of programs kept in a process."""


def program(
    name: str,
    structure: Structure,
    model: Model,
    terms: Sequence[Term],
    free_numbers: tuple[str, ...] | None = None,
) -> Nlp:
    """Return the program of one frame: the model's unknowns, the rest of q as rows, and what the terms add.

    name: of the program, for messages. structure: kinds of the tubes. model, terms: of the frame. free_numbers:
    for robots that share their motors, names of tubes' numbers that are unknowns, too, after the model's
    (robot.structure.locate_free_numbers), or empty; the motors' angles are then rows on any model, and the tilt,
    which they share, is an unknown. None for a robot of its own. Raises OptionError where two terms have
    parameters of one name.
    """
    # Cached by keys: models and terms that differ in numbers alone share one program, whose parameters these are.
    return _program(name, structure, model.program_model, _TermsByKey(terms), free_numbers)


def robot_values(robot: Robot) -> dict[str, Any]:
    """Return the parameters of every program that describe the robot, by name."""
    return {"tubes": robot.numbers}


def fill_parameters(robot: Robot, terms: Sequence[Term], frame: Frame) -> dict[str, Any]:
    """Return all parameters of the program of a robot and terms for a target frame, by name."""
    return robot_values(robot) | {key: value for term in terms for key, value in term.fill(frame).items()}


def pack_frames(nlp: Nlp, values: Sequence[Mapping[str, Any]]) -> Array:
    """Return parameters of many frames of nlp, given by name in values, as rows (frames, n_p).

    A row is what Nlp.pack returns. Raises ValueError as Nlp.pack does, or where frames differ in their parameters.
    """
    found = [nlp.pack(values[0])[None, :0].repeat(len(values), axis=0)]
    for name in nlp.parameters:
        stacked = np.array([each[name] for each in values], dtype=float)
        # All frames in one step instead of a call of pack for each: columns of a matrix follow each other,
        # as in pack.
        matrices = stacked.reshape(*stacked.shape, *(1,) * (3 - stacked.ndim))
        found.append(matrices.transpose(0, 2, 1).reshape(len(values), -1))
    return np.concatenate(found, axis=1)


class _TermsByKey(tuple[Term, ...]):
    """Terms that are equal where their keys are, so that lru_cache finds programs that differ in numbers alone."""

    @property
    def keys(self) -> tuple[Hashable, ...]:
        return tuple(term.key for term in self)

    def __hash__(self) -> int:
        return hash(self.keys)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _TermsByKey) and self.keys == other.keys


@functools.lru_cache(maxsize=MAX_CACHED_FRAME_PROGRAMS)
def _program(
    name: str, structure: Structure, model: Model, terms: _TermsByKey, free_numbers: tuple[str, ...] | None
) -> Nlp:
    """Build the program; arguments as in `program`."""
    numbers = ca.SX.sym("tubes", structure.d, len(TUBE_NUMBER_NAMES))
    parameters = {"tubes": numbers} | _parameters(structure, terms)
    places_freed = locate_free_numbers(structure, free_numbers or ())
    unknown = ca.SX.sym("freed", len(places_freed))
    known = ca.SX(numbers)
    for k, (i, columns) in enumerate(places_freed):
        for column in columns:
            # An arc's curvature stands in two columns, at root and tip: one unknown takes the place of
            # both.
            known[i, column] = unknown[k]
    tubes = symbolic_tubes(structure, known)
    counts = list[int]()

    # All terms' samples in one column: the model computes its shape once. counts tells which samples are
    # whose.
    def places(beta: Sequence[ca.SX]) -> ca.SX:
        """Return the arc lengths of the samples of all terms, mm, one term after another."""
        found = [ca.SX(term.sample_arc_lengths(beta)) for term in terms]
        counts[:] = [each.numel() for each in found]
        return ca.vertcat(*found)

    margin = parameters["margin"] if any(isinstance(term, Margin) for term in terms) else None
    tangents = any(term.tangents for term in terms)
    load = parameters[LoadTerm.name] if any(isinstance(term, LoadTerm) for term in terms) else None
    shared = free_numbers is not None
    frame = model.frame if load is None else functools.partial(model.frame_with_load, load, tilted=shared)
    shape = frame(structure, tubes, places, margin, tangents)
    q = _configuration(shape, structure.d)
    stops = list(itertools.accumulate(counts))
    bodies = (Body(q, tubes, shape, slice(stop - count, stop)) for count, stop in zip(counts, stops, strict=True))
    parts = [term.build(body, parameters) for term, body in zip(terms, bodies, strict=True)]
    return _assemble_nlp(name, shape, parameters, parts, unknown, shared)


def _parameters(structure: Structure, terms: Sequence[Term]) -> dict[str, ca.SX]:
    """Return symbols for the parameters of all terms, by name."""
    found = dict[str, ca.SX]()
    for term in terms:
        for name, size in term.parameters(structure).items():
            if name in found or name == "tubes":
                raise OptionError(f"terms have the parameter {name} twice; the second is of {term.name}")
            found[name] = ca.SX.sym(name, *size)
    return found


def _configuration(shape: SymbolicShape, d: int) -> ca.SX:
    """Return the configuration q (2d + 2, 1), picked from x and the rows."""
    if shape.picks is None:
        return shape.x
    return ca.vertcat(shape.x, *shape.rows.values())[list(shape.picks[: 2 * d + 2])]


def _assemble_nlp(
    name: str,
    shape: SymbolicShape,
    parameters: Mapping[str, ca.SX],
    parts: Sequence[Parts],
    freed: ca.SX,
    motors_shared: bool,
) -> Nlp:
    """Assemble the Nlp of a shape and the terms' parts.

    freed: free numbers of tubes, (k, 1); they and then slacks come after the model's unknowns. The part of the
    configuration that these do not contain comes first among the rows; so do the motors' angles where several
    robots share them (motors_shared).
    """
    slacks = [part.slack for part in parts if part.slack is not None]
    motors = list[Constraint]()
    n = shape.x.numel()
    more = freed.numel()
    picks = shape.picks
    if picks is not None or motors_shared:
        for row, value in shape.rows.items():
            # Rows without bounds here: the robot's limits are put on them solve by solve (Nlp.row_bounds).
            free = np.full(value.numel(), np.inf)
            motors.append(Constraint(row, value, -free, free))
    if picks is not None:
        # The model counts picks through x and then rows; freed numbers and slacks stand between both.
        picks = tuple(pick + (pick >= n) * (len(slacks) + more) for pick in picks)
    own = np.full(n + more, np.inf)
    return Nlp(
        name,
        ca.vertcat(shape.x, freed, *slacks),
        np.concatenate([-own, np.zeros(len(slacks))]),
        np.concatenate([own, np.full(len(slacks), np.inf)]),
        parameters,
        residuals=tuple(each for part in parts for each in part.residuals),
        costs=tuple(each for part in parts for each in part.costs),
        constraints=(*motors, *(each for part in parts for each in part.constraints)),
        inner=(shape.inner, *(layer for part in parts for layer in part.inner)),
        picks=picks,
        slacks=len(slacks),
    )
