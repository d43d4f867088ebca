"""Intermediate quantities, as whose functions a shape and the terms of a program are written.

A program needs second derivatives of residuals r(v(x)). With v as separate symbols, r and v are differentiated one
after the other and joined by the chain rule, which costs fewer operations than differentiating the substituted
expression (ocp/expressions.py).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca


@dataclass(frozen=True)
class Inner:
    """One layer of quantities v(x) between the unknowns x and the terms of an Nlp: a symbol and a value for each.

    Points are sums of lengths times directions, which depend on few x each: derivatives taken in two steps then
    need a third fewer operations. Layers follow each other: values of one may be written in the symbols of those
    before.
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
