"""CasADi functions as tapes: lists of instructions that a short loop in C executes for many frames together.

Straight code for a large function is millions of bytes, which a processor fetches again for every few frames, and
more slowly than it computes; and a compiler needs half a minute for it. A tape is data, an eighth as large, which
is read once for up to TAPE_BLOCK_FRAMES frames. Writing it takes no longer than listing the instructions.
"""

from __future__ import annotations

from collections.abc import Iterable

import casadi as ca

from ctr_nlp.codegen.language import (
    C_LIBRARY_FUNCTIONS,
    OPERATIONS,
    TWO_ARGUMENT_FUNCTIONS,
    VECTOR_LANES,
    file_header,
    number_in_c,
)
from ctr_nlp.codegen.vector import eliminate_common_subexpressions, interface, known_operations

TAPE_BLOCK_FRAMES = 64
"""Largest number of frames for which a tape is read once: with more, numbers leave the processor's caches."""
TAPE_OPERAND_BITS = 19
"""Bits of each of the three numbers in an instruction; the rest of 64 is the operation."""
_TAPE_INTERPRETER_C = """\
#include <stdlib.h>
#define EACH SIMD for (long l = 0; l < n; ++l)

typedef unsigned long long Instruction; /* an operation, the numbers that it takes, where its result goes */

typedef struct {{
    const Instruction *instructions;
    const double *constants;
    const long *inputs, *outputs; /* how many entries each has of one frame */
    long count, slots;
}} Tape;

/* Carry out a tape for n rows from one on, each a frame. If fewer are left, the last one stands for those that
   are missing. Every slot of the work array has a number for each of the n rows. */
static inline __attribute__((always_inline)) void played(const Tape *tape, const double *const *arg,
                                                         double *const *res, long row, long left, long n,
                                                         double *work) {{
    for (const Instruction *at = tape->instructions, *end = at + tape->count; at < end; ++at) {{
        long i = *at >> {bits} & {mask}, j = *at >> 2 * {bits} & {mask}, k = *at & {mask};
        double *to = work + k * n;
        const double *a = work + i * n, *b = work + j * n;
        switch (*at >> 3 * {bits}) {{
        case {constant}:
            EACH to[l] = tape->constants[i];
            break;
        case {input}:
            for (long l = 0; l < n; ++l) to[l] = arg[i][(row + (l < left ? l : left - 1)) * tape->inputs[i] + j];
            break;
        case {output}:
            for (long l = 0; res[k] && l < n && l < left; ++l) res[k][(row + l) * tape->outputs[k] + j] = a[l];
            break;
{cases}        }}
    }}
}}

/* The same for so many rows; 1 where there is no memory for it. */
static int played_for_all(const Tape *tape, const double *const *arg, double *const *res, long rows) {{
    long most = rows < {block} ? (rows + LANES - 1) & -LANES : {block};
    double *work = aligned_alloc(sizeof(double) * LANES, sizeof(double) * most * (tape->slots + 1));
    if (!work) return 1;
    for (long row = 0, left = rows; left > 0; row += {block}, left -= {block}) {{
        if (left > {block} - LANES) /* a loop of which the compiler knows the length */
            played(tape, arg, res, row, left, {block}, work);
        else
            played(tape, arg, res, row, left, (left + LANES - 1) & -LANES, work);
    }}
    free(work);
    return 0;
}}

"""
"""The loop that executes tapes, with a case for each operation that a file uses."""


def tape_code(functions: tuple[ca.Function, ...]) -> str:
    """Return a C file for functions with dense inputs and outputs.

    Each has `int NAME_rows(const double **arg, double **res, long rows)`, whose inputs and outputs have a row for
    each frame, and can be loaded by casadi.external as that of VECTOR_LANES frames, whose columns are side by
    side. Raises NotImplementedError for operations without C, and for functions that are too large.
    """
    # The interpreter loop does every instruction, so that repeated ones would cost as often.
    functions = tuple(eliminate_common_subexpressions(function) for function in functions)
    used = known_operations(functions)
    return file_header(used, None) + _tape_interpreter(used) + "".join(_tape(function) for function in functions)


def _tape_interpreter(used: set[int]) -> str:
    """Return the loop in C, with cases for the operations that are used."""
    numbers = {"bits": TAPE_OPERAND_BITS, "mask": (1 << TAPE_OPERAND_BITS) - 1, "block": TAPE_BLOCK_FRAMES}
    # Instructions that move numbers have other operands than operations, and cases of their own in the
    # loop.
    moves = {"constant": ca.OP_CONST, "input": ca.OP_INPUT, "output": ca.OP_OUTPUT}
    cases = "".join(
        f"        case {operation}:\n            EACH to[l] = {_value(operation)};\n            break;\n"
        for operation in sorted(used - set(moves.values()))
    )
    return _TAPE_INTERPRETER_C.format(cases=cases, **numbers, **moves)


def _value(operation: int) -> str:
    """Return C for the result of an operation, for frame l."""
    of = "a[l]", "b[l]"
    if operation in OPERATIONS:
        return OPERATIONS[operation].format(*of)
    called = C_LIBRARY_FUNCTIONS[operation]
    return f"by_lane_{called}({', '.join(of[: 2 if called in TWO_ARGUMENT_FUNCTIONS else 1])})"


def _tape(function: ca.Function) -> str:
    """Return C of one function: its tape, and its entry points for rows and for CasADi."""
    name = function.name()
    constants = list[float]()
    instructions = [_instruction(function, k, constants) for k in range(function.n_instructions())]
    sizes_in = [function.numel_in(i) for i in range(function.n_in())]
    sizes_out = [function.numel_out(i) for i in range(function.n_out())]
    # casadi.external sees VECTOR_LANES frames as columns. Column after column of a dense matrix is the same memory
    # as row after row, so that the rows' entry point serves both.
    for_casadi = interface(function, f"    return {name}_rows(arg, res, LANES);\n", VECTOR_LANES)
    arrays = {
        "const Instruction": ("instructions", [f"{each}u" for each in instructions]),
        "const double": ("constants", [number_in_c(each) for each in constants]),
    }
    return f"""\
{"".join(_array(kind, f"{name}_{called}", values) for kind, (called, values) in arrays.items())}\
{_array("const long", f"{name}_inputs", map(str, sizes_in))}\
{_array("const long", f"{name}_outputs", map(str, sizes_out))}\
static const Tape {name}_tape = {{
    {name}_instructions, {name}_constants, {name}_inputs, {name}_outputs, {len(instructions)}, {function.sz_w()}
}};
int {name}_rows(const double **arg, double **res, long rows) {{
    return played_for_all(&{name}_tape, arg, res, rows);
}}
{for_casadi}"""


def _instruction(function: ca.Function, k: int, constants: list[float]) -> int:
    """Return instruction k as one number; a constant that it takes is appended to `constants`."""
    operation = function.instruction_id(k)
    to = function.instruction_output(k)
    of = function.instruction_input(k)
    if operation == ca.OP_CONST:
        of = [len(constants), 0]
        constants.append(function.instruction_constant(k))
    elif operation == ca.OP_OUTPUT:
        # An output's destination is (which output, entry): the entry takes the place of the second
        # argument.
        of = [of[0], to[1]]
        to = to[:1]
    # One-argument operations repeat it as the second, which their case does not read.
    numbers = of[0], of[-1], to[0]
    if max(numbers) >> TAPE_OPERAND_BITS:
        raise NotImplementedError(
            f"{function.name()} has numbers beyond {1 << TAPE_OPERAND_BITS}, which no instruction tells"
        )
    found: int = operation
    # From the highest bits: operation, second argument, first argument, destination, as the loop reads
    # them.
    for number in numbers[1], numbers[0], numbers[2]:
        found = found << TAPE_OPERAND_BITS | number
    return found


def _array(kind: str, name: str, values: Iterable[str]) -> str:
    """Return a static array in C; an empty one gets a 0, since C has no arrays of length 0."""
    return f"static {kind} {name}[] = {{{', '.join(values) or 0}}};\n"
