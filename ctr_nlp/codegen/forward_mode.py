"""CasADi functions as C that computes, beside every number, its slopes over the unknowns, in vectors.

As straight code of numbers, second derivatives have each operation once more for every unknown. That is longer
than what a processor keeps in its instruction cache, so that it waits for code. Here a number is followed by one
vector with its slopes over up to VECTOR_LANES unknowns: forward differentiation in as many directions together.
For r = op(a, b), with slopes r', a', b' (rows over the unknowns), r' = op_a a' + op_b b'; DERIVATIVE_FACTORS has
op_a and op_b. Applied to a gradient, this gives the Hessian.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import casadi as ca

from ctr_nlp.codegen.language import VECTOR_LANES, file_header
from ctr_nlp.codegen.vector import (
    eliminate_common_subexpressions,
    instruction_of,
    known_operations,
    name_in_c,
    needed_later,
    part_starts,
    pause_after,
    result_in_c,
    store_output,
)

FORWARD_MODE_PART_INSTRUCTIONS = 100
"""Instructions in one part of the body; with their slopes these are as long as the parts in vector.py."""
_ZERO_FACTOR, _UNIT_FACTOR, _SIGN_FACTOR = "", "1.0", "(one_where({0} > 0.0) - one_where({0} < 0.0))"
"""Factors that many operations share: none (the slope is 0), one, and the sign of the argument."""
_LESS_THAN_FACTOR = "(0.5 * (one_where({{{0}}} < {{{1}}}) + one_where({{{0}}} <= {{{1}}})))"
"""1 if one number is less than another, 0 if it is more, and half where they are equal, as in CasADi."""
DERIVATIVE_FACTORS = {
    ca.OP_ADD: (_UNIT_FACTOR, _UNIT_FACTOR),
    ca.OP_SUB: (_UNIT_FACTOR, "-1.0"),
    ca.OP_MUL: ("{1}", "{0}"),
    # Results {r} are reused where they save an operation: d(a / b)/db = -(a / b) / b.
    ca.OP_DIV: ("(1.0 / {1})", "(-{r} / {1})"),
    ca.OP_NEG: ("-1.0",),
    ca.OP_SQ: ("(2.0 * {0})",),
    ca.OP_TWICE: ("2.0",),
    ca.OP_INV: ("(-{r} * {r})",),
    # Comparisons are piecewise constant: slope 0, as in CasADi, also where they jump.
    ca.OP_LT: (_ZERO_FACTOR, _ZERO_FACTOR),
    ca.OP_LE: (_ZERO_FACTOR, _ZERO_FACTOR),
    ca.OP_EQ: (_ZERO_FACTOR, _ZERO_FACTOR),
    ca.OP_NE: (_ZERO_FACTOR, _ZERO_FACTOR),
    ca.OP_NOT: (_ZERO_FACTOR,),
    ca.OP_AND: (_ZERO_FACTOR, _ZERO_FACTOR),
    ca.OP_OR: (_ZERO_FACTOR, _ZERO_FACTOR),
    # The value, not the condition, has a slope, and only where it is chosen.
    ca.OP_IF_ELSE_ZERO: (_ZERO_FACTOR, "one_where({0} != 0.0)"),
    ca.OP_FMIN: (_LESS_THAN_FACTOR.format(0, 1), _LESS_THAN_FACTOR.format(1, 0)),
    ca.OP_FMAX: (_LESS_THAN_FACTOR.format(1, 0), _LESS_THAN_FACTOR.format(0, 1)),
    ca.OP_SIGN: (_ZERO_FACTOR,),
    ca.OP_FABS: (_SIGN_FACTOR,),
    ca.OP_SQRT: ("(0.5 / {r})",),
    ca.OP_SIN: ("cos({0})",),
    ca.OP_COS: ("-sin({0})",),
    ca.OP_TAN: ("(1.0 + {r} * {r})",),
    ca.OP_ASIN: ("(1.0 / sqrt(1.0 - {0} * {0}))",),
    ca.OP_ACOS: ("(-1.0 / sqrt(1.0 - {0} * {0}))",),
    ca.OP_ATAN: ("(1.0 / (1.0 + {0} * {0}))",),
    ca.OP_SINH: ("cosh({0})",),
    ca.OP_COSH: ("sinh({0})",),
    ca.OP_TANH: ("(1.0 - {r} * {r})",),
    ca.OP_EXP: ("{r}",),
    ca.OP_LOG: ("(1.0 / {0})",),
    ca.OP_FLOOR: (_ZERO_FACTOR,),
    ca.OP_CEIL: (_ZERO_FACTOR,),
    ca.OP_ATAN2: ("({1} / ({0} * {0} + {1} * {1}))", "(-{0} / ({0} * {0} + {1} * {1}))"),
    ca.OP_POW: ("({1} * pow({0}, {1} - 1.0))", "(log({0}) * {r})"),
    # The exponent is a constant: no slope over it, and no logarithm of a base that may be negative.
    ca.OP_CONSTPOW: ("({1} * pow({0}, {1} - 1.0))", _ZERO_FACTOR),
    ca.OP_COPYSIGN: (f"(copysign(1.0, {{1}}) * {_SIGN_FACTOR})", _ZERO_FACTOR),
}
"""Factors op_a, op_b of each operation: by the result {r} and the arguments {0}, {1}; empty where the
slope is 0.
"""


class Chunk(NamedTuple):
    """Unknowns whose slopes are in one vector: the first of them, and their number."""

    first: int
    unknowns: int

    @classmethod
    def all_of(cls, unknowns: int) -> list[Chunk]:
        """Return the chunks for so many unknowns."""
        return [cls(first, min(VECTOR_LANES, unknowns - first)) for first in range(0, unknowns, VECTOR_LANES)]

    @property
    def lanes(self) -> int:
        """Lanes of the vector: the next power of two, since compilers have no other vectors."""
        # The last chunk may have fewer unknowns than VECTOR_LANES: a smaller vector is enough for it.
        return 1 << (self.unknowns - 1).bit_length()

    @property
    def kind(self) -> str:
        """Type of the vector in C."""
        return f"D{self.lanes}"

    def unit(self, unknown: int) -> str:
        """Return C for the slopes of the unknown with number `unknown` over the chunk: 1 in its own lane."""
        entries = ", ".join(_UNIT_FACTOR if lane == unknown - self.first else "0.0" for lane in range(self.lanes))
        return f"({self.kind}){{{entries}}}"


class FunctionWithJacobian(NamedTuple):
    """A function whose first input is the unknowns, and the outputs whose slopes over these are wanted.

    slopes: for the number of each such output, the entries of its Jacobian that are stored, column by column.
    """

    function: ca.Function
    slopes: Mapping[int, ca.Sparsity]


def forward_mode_code(functions: Sequence[FunctionWithJacobian]) -> str:
    """Return a C file for functions with dense inputs and outputs, all with the same number of unknowns.

    Each becomes `static void NAME(const double **arg, double **res)`. Results are the outputs, and then, in the
    order of their numbers, the slopes that are wanted. Names of outputs that begin with EARLY_OUTPUT_PREFIX have
    the meaning that they have in vector.py. Raises NotImplementedError for operations without C.
    """
    alone = [each._replace(function=eliminate_common_subexpressions(each.function)) for each in functions]
    used = known_operations(tuple(each.function for each in alone))
    bodies = [_Body(each) for each in alone]
    kinds = {chunk.kind: chunk.lanes for body in bodies for chunk in body.chunks}
    types = "".join(f"typedef double {kind} __attribute__((vector_size({8 * n})));\n" for kind, n in kinds.items())
    return "".join([file_header(used, 1), types, *(body.code() for body in bodies)])


class _Body:
    """Instructions of a function, with the slopes that each needs.

    taken: for each instruction, the instructions whose results it takes. sloped: for each, the chunks over which
    its slopes are found.
    """

    def __init__(self, directed: FunctionWithJacobian) -> None:
        self.function, self.wanted = directed
        self.chunks = Chunk.all_of(self.function.numel_in(0)) if self.wanted else []
        self.pause = pause_after(self.function)
        self.starts = part_starts(self.function, self.pause, FORWARD_MODE_PART_INSTRUCTIONS)
        self.instructions = [instruction_of(self.function, k) for k in range(self.function.n_instructions())]
        self.taken = self._find_argument_instructions()
        self.sloped = self._find_slope_chunks()

    def _find_argument_instructions(self) -> list[list[int]]:
        """Return for each instruction those that computed its arguments; slots of the work vector are reused."""
        made = dict[int, int]()
        taken = list[list[int]]()
        for k, (operation, to, of) in enumerate(self.instructions):
            # An output takes one slot, an operation at most two.
            slots = [] if operation in (ca.OP_CONST, ca.OP_INPUT) else of[: 1 if operation == ca.OP_OUTPUT else 2]
            taken.append([made[slot] for slot in slots])
            if operation != ca.OP_OUTPUT:
                made[to[0]] = k
        return taken

    def _differentiable_arguments(self, k: int) -> list[int]:
        """Return the instructions on whose results that of k depends with slopes other than 0."""
        operation = self.instructions[k][0]
        if operation == ca.OP_OUTPUT:
            return self.taken[k]
        return [j for j, slope in zip(self.taken[k], DERIVATIVE_FACTORS.get(operation, ()), strict=False) if slope]

    def _find_slope_chunks(self) -> list[set[int]]:
        """Return for each instruction the chunks over which its slopes are not always 0 and outputs need them."""
        # Forward: chunks that a result depends on. Backward: chunks that some wanted output needs it for.
        # Only what is in both is computed.
        moved = list[set[int]]()
        needed = [set[int]() for _ in self.instructions]
        for k, (operation, _, of) in enumerate(self.instructions):
            # Entry j of input 0 is unknown j: it follows itself alone, in one chunk.
            own = {of[1] // VECTOR_LANES} if self.chunks and operation == ca.OP_INPUT and of[0] == 0 else set()
            moved.append(own.union(*(moved[j] for j in self._differentiable_arguments(k))))
        for k in reversed(range(len(moved))):
            operation, to, _ = self.instructions[k]
            if operation == ca.OP_OUTPUT:
                needed[k] = moved[k] if to[0] in self.wanted else set()
            needed[k] &= moved[k]
            for j in self._differentiable_arguments(k):
                needed[j] |= needed[k]
        return needed

    def code(self) -> str:
        """Return C of the whole, part by part; results that later parts need are stored in w and v0, v1, ..."""
        name = self.function.name()
        size = self.function.sz_w()
        # A work vector for numbers, and one for each chunk's slopes, with the same slots.
        works = [("double", "w"), *((chunk.kind, f"v{c}") for c, chunk in enumerate(self.chunks))]
        parameters = "".join(f", {kind} *{work}" for kind, work in works)
        given = "".join(f", {work}" for _, work in works)
        parts = self._parts()
        bodies = "".join(
            f"static __attribute__((noinline)) void {name}_{k}"
            f"(const double *const *arg, double *const *res{parameters}) {{\n{''.join(part)}}}\n"
            for k, part in enumerate(parts)
        )
        calls = [f"    {name}_{k}(arg, res{given});\n" for k in range(len(parts))]
        if self.pause:
            # A part begins right after the pause, so that the call comes between two parts.
            calls.insert(self.starts.index(self.pause), f"    {name}_pause(arg, res);\n")
        room = "".join(f"    {kind} {work}[{size}];\n" for kind, work in works)
        return f"{bodies}static void {name}(const double **arg, double **res) {{\n{room}{''.join(calls)}}}\n"

    def _parts(self) -> list[list[str]]:
        """Return lines of C, part by part: each number is followed by its slopes."""
        later = needed_later(self.function, self.starts)
        parts = list[list[str]]()
        here = dict[int, str]()
        for k, (operation, to, of) in enumerate(self.instructions):
            if k in self.starts:
                parts.append([])
                here.clear()
            if operation == ca.OP_OUTPUT:
                told = store_output(self.function, to, name_in_c(of[0], here))
                parts[-1] += [told, *self._store_jacobian_row(k, here)]
                continue
            sloped = sorted(self.sloped[k])
            lines = [f"double t{k} = {result_in_c(self.function, k, here)};"]
            # t7 is the result of instruction 7, t7_0 its slopes over chunk 0.
            lines += [f"{self.chunks[c].kind} t{k}_{c} = {self._slopes(k, c, here)};" for c in sloped]
            if k in later:
                lines += [f"w[{to[0]}] = t{k};", *(f"v{c}[{to[0]}] = t{k}_{c};" for c in sloped)]
            here[to[0]] = f"t{k}"
            parts[-1].append(" ".join(lines) + "\n")
        return parts

    def _slopes(self, k: int, c: int, here: dict[int, str]) -> str:
        """Return C for the slopes of the result of k over chunk c: factors times the arguments' slopes, summed."""
        operation, _, of = self.instructions[k]
        if operation == ca.OP_INPUT:
            return self.chunks[c].unit(of[1])
        names = [name_in_c(slot, here) for slot in of]
        slopes = zip(of, self.taken[k], DERIVATIVE_FACTORS[operation], strict=False)
        return " + ".join(
            f"{slope.format(*names, r=f't{k}')} * {_vector(slot, c, here)}"
            for slot, j, slope in slopes
            # Arguments that do not depend on the chunk's unknowns have slopes 0, which are not stored
            # anywhere.
            if slope and c in self.sloped[j]
        )

    def _store_jacobian_row(self, k: int, here: dict[int, str]) -> list[str]:
        """Return C that stores the entries of a Jacobian's row when its output has been computed."""
        _, (number, row), of = self.instructions[k]
        if number not in self.wanted:
            return []
        # Slopes come after all outputs, in the order of the outputs' numbers.
        result = self.function.n_out() + sorted(self.wanted).index(number)
        pattern = self.wanted[number]
        lines = list[str]()
        # get_triplet lists entries column by column, the order in which they are stored.
        for entry, (at, column) in enumerate(zip(*pattern.get_triplet(), strict=True)):
            if at == row:
                c = column // VECTOR_LANES
                slope = f"({_vector(of[0], c, here)})[{column % VECTOR_LANES}]" if c in self.sloped[k] else "0.0"
                lines.append(f"res[{result}][{entry}] = {slope};\n")
        return [f"if (res[{result}]) {{\n{''.join(lines)}}}\n"] if lines else []


def _vector(slot: int, c: int, here: dict[int, str]) -> str:
    """Return C for the slopes over chunk c of the result in a slot: of this part, or stored by an earlier one."""
    return f"{here[slot]}_{c}" if slot in here else f"v{c}[{slot}]"
