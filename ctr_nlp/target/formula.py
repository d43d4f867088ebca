"""A curve's formula as the steps of its evaluation: values that can be compared, sent and written to a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca

from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.equal import Value
from ctr_nlp.support.packing import packable
from ctr_nlp.target.points import symbolic_point
from ctr_nlp.typing import Array

NAMES = {getattr(ca, name): name[3:].lower() for name in dir(ca) if name.startswith("OP_")}
CODES = {name: code for code, name in NAMES.items()}
"""CasADi's operations by number, and their numbers."""
Step = tuple[str, float, tuple[int, ...], int]
"""An operation, its constant, the places that it reads, and the one that it writes: a coordinate for `output`."""


@packable("formula")
@dataclass(frozen=True, eq=False)
class Formula(Value):
    """x(u) in mm, step by step."""

    steps: tuple[Step, ...]

    @classmethod
    def of(cls, formula: Callable[[Any], tuple[Any, Any, Any]]) -> Formula:
        """That of a function written with CasADi's own; raises CurveError."""
        u = ca.SX.sym("u")
        function = ca.Function("x", [u], [ca.densify(symbolic_point(formula, u))])
        return cls(tuple(_step(function, k) for k in range(function.n_instructions())))

    @cached_property
    def _functions(self) -> tuple[ca.Function, ...]:
        """U to x and its first two derivatives."""
        u = ca.SX.sym("u")
        orders = [self._expression(u)]
        for _ in range(2):
            orders.append(ca.jacobian(orders[-1], u))
        return tuple(ca.Function(f"d{i}", [u], [expression]) for i, expression in enumerate(orders))

    def _expression(self, u: ca.SX) -> ca.SX:
        places: dict[int, ca.SX] = {}
        x = [ca.SX(0)] * 3
        for name, constant, reads, writes in self.steps:
            if name == "output":
                x[writes] = places[reads[0]]
                continue
            read = [places[place] for place in reads]
            if name == "input":
                places[writes] = u
            elif name == "const":
                places[writes] = ca.SX(constant)
            else:
                places[writes] = (ca.SX.unary if len(read) == 1 else ca.SX.binary)(CODES[name], *read)
        return ca.vertcat(*x)

    def derivative(self, u: Array, order: int) -> Array:
        """x(u) (n, 3), or its first or second derivative, at u (n,)."""
        return self._functions[order](u[None]).full().T

    bending = derivative


def _step(function: ca.Function, k: int) -> Step:
    code, reads, writes = function.instruction_id(k), function.instruction_input(k), function.instruction_output(k)
    name = NAMES.get(code, "")
    if name == "call" or not writes:
        raise CurveError("formula calls a function that is kept apart from it (never_inline); write it out")
    if name == "output":
        return name, 0.0, (reads[0],), writes[1]
    constant = function.instruction_constant(k) if name == "const" else 0.0
    return name, constant, () if name == "input" else tuple(reads), writes[0]
