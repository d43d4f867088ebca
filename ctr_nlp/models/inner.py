"""Intermediate quantities, in whose symbols a shape and the terms of a program may be written."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca


@dataclass(frozen=True)
class Inner:
    """Quantities between x and the terms of an Nlp, in whose symbols the terms may be written.

    Where residuals are simple in a few quantities and these depend on few x each, as points that are sums of
    lengths times directions, derivatives taken in two steps need a third fewer operations. Layers of them follow
    each other: the values of one may be written in the symbols of those before.
    """

    symbols: tuple[ca.SX, ...] = ()
    values: tuple[ca.SX, ...] = ()

    @classmethod
    def of(cls, values: Sequence[ca.SX]) -> Inner:
        """Make a layer of values, with a new symbol of the same shape for each."""
        # Dense, since a symbol is: entries that are zero by structure would have no symbol to match.
        dense = tuple(ca.densify(value) for value in values)
        return cls(tuple(ca.SX.sym("inner", *value.shape) for value in dense), dense)

    @property
    def columns(self) -> tuple[ca.SX, ca.SX]:
        """All symbols, and all values, in one column."""
        symbols, values = ([ca.vec(each) for each in part] for part in (self.symbols, self.values))
        return ca.vertcat(ca.SX(0, 1), *symbols), ca.vertcat(ca.SX(0, 1), *values)
