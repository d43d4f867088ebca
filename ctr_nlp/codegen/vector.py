"""CasADi functions as C that evaluates several frames together, a frame in each lane of the processor's vectors.

CasADi's own C evaluates one frame after the other, in one body for which compilers need minutes. Here every number
is a vector, and the body is cut into parts, so that compile time grows in proportion to length.
"""

from __future__ import annotations

import bisect

import casadi as ca

from ctr_nlp.codegen.language import C_LIBRARY_FUNCTIONS, OPERATIONS, VECTOR_LANES, file_header, number_in_c

SHARED_INPUT_PREFIX = "same_"
"""Prefix of names of inputs that all frames share."""
ADJACENT_LANES_PREFIX = "beside_"
"""Prefix of names of inputs and outputs whose entries have their lanes next to each other in memory.

An entry of an output is a vector. Those of an input overlap: the number after an entry is its next lane.
"""
EARLY_OUTPUT_PREFIX = "early_"
"""Prefix of names of outputs that are computed first. After them `NAME_pause(arg, res)` is called, which must be
defined earlier in the file: it may read them and fill inputs that are read later.
"""
VECTOR_PART_INSTRUCTIONS = 300
"""Instructions in one part of the body."""
Sizes = list[tuple[int, int, int]]
"""Rows and columns of inputs or outputs, and the number of lanes for which the columns are repeated."""


def vector_code(functions: tuple[ca.Function, ...], lanes: int = VECTOR_LANES) -> str:
    """Return a C file for functions with dense inputs and outputs.

    Operations that are repeated are done once. casadi.external loads them under their names; inputs and outputs
    have `lanes` times the columns, as those of `function.map(lanes)`, but for inputs whose names begin with
    SHARED_INPUT_PREFIX. With one lane numbers are numbers. Raises NotImplementedError for operations without C.
    """
    functions = tuple(eliminate_common_subexpressions(function) for function in functions)
    # Repetitions are removed first, so that operations are listed as they will be written.
    return file_header(known_operations(functions), lanes) + "".join(_function(each, lanes) for each in functions)


def known_operations(functions: tuple[ca.Function, ...]) -> set[int]:
    """Return the operations that functions use; raises NotImplementedError for those without C."""
    used = {function.instruction_id(k) for function in functions for k in range(function.n_instructions())}
    if unknown := used - OPERATIONS.keys() - C_LIBRARY_FUNCTIONS.keys() - {ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT}:
        names = ", ".join(function.name() for function in functions)
        raise NotImplementedError(f"{names} uses operations (numbers {sorted(unknown)}) that are not written in C")
    return used


def eliminate_common_subexpressions(function: ca.Function) -> ca.Function:
    """Return the function with common subexpressions eliminated."""
    inputs = [ca.SX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
    # Names are kept, since their prefixes say how inputs and outputs are laid out.
    names = function.name_in(), function.name_out()
    return ca.Function(function.name(), inputs, function.call(inputs), *names, {"cse": True})


def _function(function: ca.Function, lanes: int) -> str:
    """Return C of one function: its parts, and the function that calls them."""
    name = function.name()
    pause = pause_after(function)
    parts = _parts(function, pause, lanes)
    bodies = "".join(
        # Not inlined: one large body would take the compiler's time again.
        f"static __attribute__((noinline)) void {name}_{k}"
        f"(const double *const *arg, double *const *res, V *w) {{\n{''.join(part)}}}\n"
        for k, part in enumerate(parts)
    )
    calls = [f"    {name}_{k}(arg, res, v);\n" for k in range(len(parts))]
    if pause:
        # Parts before the pause are whole parts of VECTOR_PART_INSTRUCTIONS instructions, the last one shorter: so
        # many calls come first.
        calls.insert(-(-pause // VECTOR_PART_INSTRUCTIONS), f"    {name}_pause(arg, res);\n")
    body = "".join([f"    V v[{function.sz_w()}];\n", *calls, "    return 0;\n"])
    return bodies + interface(function, body, lanes)


def pause_after(function: ca.Function) -> int:
    """Return the number of instructions of `function` until all its early outputs are known; 0 without any."""
    early = sum(function.name_out(i).startswith(EARLY_OUTPUT_PREFIX) for i in range(function.n_out()))
    outputs = (k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_OUTPUT)
    return max((k + 1 for k in outputs if function.instruction_output(k)[0] < early), default=0)


def part_starts(function: ca.Function, pause: int, part: int) -> list[int]:
    """Return the numbers of the instructions of `function` with which parts begin; one begins right after a pause.

    pause: number of instructions before the pause. part: number of instructions in one part.
    """
    return [*range(0, pause, part), *range(pause, function.n_instructions(), part)]


def _parts(function: ca.Function, pause: int, lanes: int) -> list[list[str]]:
    """Return the body, part by part: numbers have names of their own; later parts read them from w."""
    starts = part_starts(function, pause, VECTOR_PART_INSTRUCTIONS)
    needed = needed_later(function, starts)
    pairs = _wave_pairs(function, starts) if lanes > 1 else {}
    # Named numbers let the compiler keep them in registers. Only those that a later part needs are stored
    # in w: each part is a C function, and sees nothing else of the others.
    parts: list[list[str]] = []
    here: dict[int, str] = {}
    for k in range(function.n_instructions()):
        if k in starts:
            parts.append([])
            here.clear()
        operation, to, of = instruction_of(function, k)
        if operation == ca.OP_OUTPUT:
            line = store_output(function, to, name_in_c(of[0], here))
        else:
            kept = f" w[{to[0]}] = t{k};" if k in needed else ""
            line = f"V t{k} = {result_in_c(function, k, here)};{kept}\n"
            if k in pairs:
                # The first of a sine and a cosine of one angle computes both.
                sine, cosine = pairs[k]
                both = f"V t{sine}, t{cosine}; t{sine} = sine_and_cosine({name_in_c(of[0], here)}, &t{cosine});"
                line = f"{both if k == min(sine, cosine) else ''}{kept}\n"
            here[to[0]] = f"t{k}"
        parts[-1].append(line)
    return parts


def _wave_pairs(function: ca.Function, starts: list[int]) -> dict[int, tuple[int, int]]:
    """Return the sines and cosines of one angle in one part of `function`: for both, the numbers of their
    instructions.
    """
    made: dict[int, int] = {}
    found: dict[tuple[int, int], dict[int, int]] = {}
    for k in range(function.n_instructions()):
        operation, to, of = instruction_of(function, k)
        if operation in (ca.OP_SIN, ca.OP_COS):
            found.setdefault((made[of[0]], bisect.bisect(starts, k)), {})[operation] = k
        if operation != ca.OP_OUTPUT:
            made[to[0]] = k
    pairs = [(each[ca.OP_SIN], each[ca.OP_COS]) for each in found.values() if len(each) == 2]
    return {k: pair for pair in pairs for k in pair}


def store_output(function: ca.Function, to: list[int], value: str) -> str:
    """Return C that stores `value` in an entry of an output of `function`; to: numbers of the output and of the
    entry.
    """
    number, entry = to
    if function.name_out(number).startswith(ADJACENT_LANES_PREFIX):
        return f"put({value}, res[{number}] + {entry} * LANES);\n"
    return f"if (res[{number}]) scattered({value}, res[{number}] + {entry}, {function.numel_out(number)});\n"


def instruction_of(function: ca.Function, k: int) -> tuple[int, list[int], list[int]]:
    """Return operation, destination and arguments of instruction k of `function`.

    The latter two are slots of the work vector, or which input or output, and its entry.
    """
    return function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)


def needed_later(function: ca.Function, starts: list[int]) -> set[int]:
    """Return the instructions of `function` whose results a later part than their own uses, for parts with these
    starts.
    """
    # Which instruction filled each slot last; slots are reused, so that a slot alone does not identify a
    # number.
    made: dict[int, int] = {}
    needed = set()
    for k in range(function.n_instructions()):
        operation, to, of = instruction_of(function, k)
        if operation not in (ca.OP_INPUT, ca.OP_CONST):
            # The part of instruction k starts at the last start that is not after k.
            begun = starts[bisect.bisect(starts, k) - 1]
            needed |= {made[slot] for slot in of if made[slot] < begun}
        if operation != ca.OP_OUTPUT:
            made[to[0]] = k
    return needed


def _is_shared_input(function: ca.Function, number: int) -> bool:
    """Return whether all frames share input `number`."""
    return bool(function.name_in(number).startswith(SHARED_INPUT_PREFIX))


def name_in_c(slot: int, here: dict[int, str]) -> str:
    """Return C for the number in a slot of the work vector; here: names of numbers that this part has computed."""
    return here.get(slot, f"w[{slot}]")


def result_in_c(function: ca.Function, k: int, here: dict[int, str]) -> str:
    """Return C for the result of instruction k of `function`; here: this part's names by slot of
    the work vector.
    """
    operation, _, of = instruction_of(function, k)
    if operation == ca.OP_CONST:
        return f"all({number_in_c(function.instruction_constant(k))})"
    if operation == ca.OP_INPUT and _is_shared_input(function, of[0]):
        return f"all(arg[{of[0]}][{of[1]}])"
    if operation == ca.OP_INPUT and function.name_in(of[0]).startswith(ADJACENT_LANES_PREFIX):
        return f"taken(arg[{of[0]}] + {of[1]})"
    if operation == ca.OP_INPUT:
        # Frames are columns: entry e of lane l stands at e + l * (entries of one frame).
        return f"gathered(arg[{of[0]}] + {of[1]}, {function.numel_in(of[0])})"
    names = [name_in_c(slot, here) for slot in of]
    if operation in OPERATIONS:
        return OPERATIONS[operation].format(*names)
    return f"by_lane_{C_LIBRARY_FUNCTIONS[operation]}({', '.join(names)})"


def interface(function: ca.Function, body: str, lanes: int) -> str:
    """Return the C functions that casadi.external looks for, around the body of the one that evaluates `function`.

    lanes: number of frames that one call evaluates.
    """
    of_lanes = [1 if _is_shared_input(function, i) else lanes for i in range(function.n_in())]
    sizes_in = [(*function.size_in(i), times) for i, times in enumerate(of_lanes)]
    sizes_out = [(*function.size_out(i), lanes) for i in range(function.n_out())]
    return casadi_entry_points(function.name(), body, sizes_in, sizes_out)


def casadi_entry_points(name: str, body: str, sizes_in: Sizes, sizes_out: Sizes) -> str:
    """Return the C functions that casadi.external looks for, for a function with dense inputs and outputs.

    name: of the function. body: C of its evaluation. sizes_in, sizes_out: shapes of inputs and outputs.
    """
    return f"""\
int {name}(const double **arg, double **res, long long *iw, double *w, int mem) {{
{body}}}
long long {name}_n_in(void) {{ return {len(sizes_in)}; }}
long long {name}_n_out(void) {{ return {len(sizes_out)}; }}
{_sparsities(f"{name}_sparsity_in", sizes_in)}{_sparsities(f"{name}_sparsity_out", sizes_out)}"""


def _sparsities(name: str, sizes: Sizes) -> str:
    """Return C of the function from which CasADi reads the shapes of inputs or outputs."""
    # CasADi's compact pattern of a dense matrix: rows, columns, 1.
    rows = ", ".join(f"{{{rows}, {times * columns}, 1}}" for rows, columns, times in sizes)
    return (
        f"const long long *{name}(long long i) {{\n    static const long long dense[][3] = {{{rows}}};\n"
        f"    return dense[i];\n}}\n"
    )
