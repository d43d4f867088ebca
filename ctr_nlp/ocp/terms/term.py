"""The interface of a term of a frame's program, and the part of a robot's shape that it is given.

Objectives are in mm^2: residuals in mm are squared, costs are not. Terms know arc lengths, points and tangents,
not how a model computes them.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.models import SymbolicShape
from ctr_nlp.models.inner import Inner
from ctr_nlp.ocp.nlp import Constraint, CostTerm, Residual
from ctr_nlp.paths.target import Frame
from ctr_nlp.robot.structure import Structure, Tubes
from ctr_nlp.typing import Vector

Symbols = Mapping[str, ca.SX]
"""Symbols of parameters, by name."""


@dataclass(frozen=True)
class Body:
    """The robot as a term sees it, in symbols: its configuration, and its shape at the term's own sample points.

    Attributes
    ----------
    q : ca.SX
        Configuration (2d + 2, 1): alpha in rad, beta in mm, theta in rad, eq. (5).
    tubes : Tubes
        The tubes, with symbols for numbers.
    shape : SymbolicShape
        The shape at the sample points of all terms; `points` and `tangents` are those of this term.
    span : slice
        Which sample points of `shape` are this term's.
    """

    q: ca.SX
    tubes: Tubes
    shape: SymbolicShape
    span: slice

    @property
    def beta(self) -> tuple[ca.SX, ...]:
        """The extensions, mm."""
        return self.shape.beta

    @property
    def points(self) -> Vector:
        """x, y, z of the sample points, each (n, 1) mm, in the base frame."""
        return self.shape.to_base_frame(self.own_points)

    @property
    def tangents(self) -> Vector:
        """x, y, z of the unit tangents at the sample points, each (n, 1), in the base frame."""
        return self.shape.to_base_frame(self.own_tangents)

    @property
    def own_points(self) -> Vector:
        """Sample points in the model's own axes, in which they need fewer operations; see
        SymbolicShape.to_shape_axes.
        """
        return self._own_samples(self.shape.points)

    @property
    def own_tangents(self) -> Vector:
        """Unit tangents at the sample points in the model's own axes."""
        assert self.shape.tangents is not None
        return self._own_samples(self.shape.tangents)

    def _own_samples(self, vectors: Vector) -> Vector:
        # The model computes the samples of all terms in one column; span picks this term's.
        """Return this term's entries of vectors at the sample points of all terms."""
        x, y, z = (axis[self.span] for axis in vectors)
        return x, y, z


@dataclass(frozen=True)
class Parts:
    """Contributions of a term to a program.

    Attributes
    ----------
    residuals : tuple of Residual
        Values in mm; the objective gains their squares.
    costs : tuple of CostTerm
        Values in mm^2, which the objective gains as they are.
    constraints : tuple of Constraint
        Values between bounds.
    inner : tuple of Inner
        Layers of quantities between the shape and the term.
    slack : ca.SX, optional
        One more unknown, >= 0.
    """

    residuals: tuple[Residual, ...] = ()
    costs: tuple[CostTerm, ...] = ()
    constraints: tuple[Constraint, ...] = ()
    inner: tuple[Inner, ...] = ()
    slack: ca.SX | None = None


class Term(ABC):
    """A residual, cost or constraint on a frame's shape. Numbers that vary from frame to frame are parameters.

    A new term is a frozen dataclass with a name, and with build; the other methods have defaults. Its fields are
    part of what is compiled, unless key omits them and they enter as parameters.

    Attributes
    ----------
    name : str
        Name in messages and of its residuals.
    tangents : bool
        Whether `build` needs the tangents at its sample points.
    of_settings : bool
        Whether the planner adds it because of its settings.
    objective_only : bool
        Whether `build` adds no constraint.

    Examples
    --------
    The cost 4 x^2, mm^2, where x is the tip's first coordinate, mm:

    >>> from ctr_nlp.ocp.nlp import Residual
    >>> @dataclass(frozen=True)
    ... class TipSide(Term):
    ...     name = "tip_side"
    ...     objective_only = True
    ...
    ...     def sample_arc_lengths(self, beta):
    ...         return beta[-1]
    ...
    ...     def build(self, body, parameters):
    ...         return Parts(residuals=(Residual(self.name, 2 * body.points[0]),))
    >>> str(TipSide())
    'TipSide()'
    """

    name: str
    tangents = False
    of_settings = False
    objective_only = False

    def __str__(self) -> str:
        """Return the term in one line, for a plan's options; of an array only its number of entries."""
        names: list[str] = [f.name for f in fields(self)] if is_dataclass(self) else []
        # Long arrays would fill a plan's options: only their size is written.
        held = {name: np.asarray(getattr(self, name)) for name in names}
        told = (
            f"{name}={value.size} numbers" if value.size > 1 else f"{name}={value.item()}"
            for name, value in held.items()
        )
        return f"{type(self).__name__}({', '.join(told)})"

    @property
    def key(self) -> Hashable:
        """Everything that `build` depends on: terms of equal keys share a compiled program."""
        return self

    def sample_arc_lengths(self, beta: Sequence[ca.SX]) -> ca.SX:
        """Return the arc lengths at which the term samples the robot; by default it needs none.

        Parameters
        ----------
        beta : sequence of ca.SX
            The d extensions, mm; the last one is the arc length of the tip.

        Returns
        -------
        ca.SX
            Arc lengths (n, 1), mm.
        """
        return ca.SX(0, 1)

    def parameters(self, structure: Structure) -> Mapping[str, tuple[int, int]]:
        """Return the shapes of the term's parameters for a structure, by name; names of two terms must differ."""
        return {}

    @abstractmethod
    def build(self, body: Body, parameters: Symbols) -> Parts:
        """Return the term's contributions, as symbols.

        Parameters
        ----------
        body : Body
            The robot at the term's sample points.
        parameters : mapping
            Symbols of this and other terms' parameters, by name.

        Returns
        -------
        Parts
            Residuals in mm, costs in mm^2, constraints.
        """

    def fill(self, frame: Frame) -> Mapping[str, Any]:
        """Return the values of the parameters for a target frame, by name."""
        return {}


def describe_terms(terms: Sequence[Term]) -> list[str]:
    """Return the given terms, except those added because of settings, each in a line, for a plan's options."""
    return [str(term) for term in terms if not term.of_settings]
