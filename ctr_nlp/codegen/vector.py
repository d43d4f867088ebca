"""CasADi functions as C that evaluates several frames at once, a frame in each lane of the processor's vectors.

CasADi's own C takes one frame after the other, in one body that compilers need minutes for. Here every number is
a vector, and the body comes in parts, so that compilers' time grows in proportion.
"""

from __future__ import annotations

import bisect

import casadi as ca

from ctr_nlp.codegen.language import BY_LANE, LANES, OPERATIONS, head, number_in_c

SAME = "same_"
"""How the names of inputs begin that all frames share."""
BESIDE = "beside_"
"""How the names of inputs and outputs begin whose entries have their lanes side by side.

An entry of an output is a vector. Those of an input overlap: what comes after an entry is its next lane.
"""
EARLY = "early_"
"""How the names of outputs begin that are found first; then `NAME_pause(arg, res)` is called, which is to be in C
before: it may read them and fill inputs that are read after.
"""
PART = 300
"""Instructions in one part of the body."""
Sizes = list[tuple[int, int, int]]
"""Rows and columns of inputs or outputs, and how often these columns come, once for each lane."""


def vector_code(functions: tuple[ca.Function, ...], lanes: int = LANES) -> str:
    """A file of C for functions with dense inputs and outputs.

    Operations that are repeated are done once. casadi.external loads them under their names; inputs and outputs
    have `lanes` times the columns, as those of `function.map(lanes)`, but for inputs whose names begin with SAME.
    With one lane numbers are numbers. Raises NotImplementedError for operations without C.
    """
    functions = tuple(without_repetition(function) for function in functions)
    return head(known_operations(functions), lanes) + "".join(_function(each, lanes) for each in functions)


def known_operations(functions: tuple[ca.Function, ...]) -> set[int]:
    """The operations of functions; raises NotImplementedError for those without C."""
    used = {function.instruction_id(k) for function in functions for k in range(function.n_instructions())}
    if unknown := used - OPERATIONS.keys() - BY_LANE.keys() - {ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT}:
        names = ", ".join(function.name() for function in functions)
        raise NotImplementedError(f"{names} uses operations (numbers {sorted(unknown)}) that are not written in C")
    return used


def without_repetition(function: ca.Function) -> ca.Function:
    """The same function with each operation on the same numbers done once."""
    inputs = [ca.SX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
    names = function.name_in(), function.name_out()
    return ca.Function(function.name(), inputs, function.call(inputs), *names, {"cse": True})


def _function(function: ca.Function, lanes: int) -> str:
    name, pause = function.name(), pause_after(function)
    parts = _parts(function, pause)
    bodies = "".join(
        f"static __attribute__((noinline)) void {name}_{k}"
        f"(const double *const *arg, double *const *res, V *w) {{\n{''.join(part)}}}\n"
        for k, part in enumerate(parts)
    )
    calls = [f"    {name}_{k}(arg, res, v);\n" for k in range(len(parts))]
    if pause:
        calls.insert(-(-pause // PART), f"    {name}_pause(arg, res);\n")
    body = "".join([f"    V v[{function.sz_w()}];\n", *calls, "    return 0;\n"])
    return bodies + interface(function, body, lanes)


def pause_after(function: ca.Function) -> int:
    """How many instructions come until all early outputs have been found; 0 where there are none."""
    early = sum(function.name_out(i).startswith(EARLY) for i in range(function.n_out()))
    outputs = (k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_OUTPUT)
    return max((k + 1 for k in outputs if function.instruction_output(k)[0] < early), default=0)


def starts_of(function: ca.Function, pause: int, part: int) -> list[int]:
    """The instructions with which parts of that length begin; one of them is that after a pause."""
    return [*range(0, pause, part), *range(pause, function.n_instructions(), part)]


def _parts(function: ca.Function, pause: int) -> list[list[str]]:
    """The body, part by part: numbers have names of their own, and go on to later parts in the work vector w."""
    starts = starts_of(function, pause, PART)
    needed = needed_later(function, starts)
    parts: list[list[str]] = []
    here: dict[int, str] = {}
    for k in range(function.n_instructions()):
        if k in starts:
            parts.append([])
            here.clear()
        operation, to, of = instruction_of(function, k)
        if operation == ca.OP_OUTPUT:
            line = told_in(function, to, name_of(of[0], here))
        else:
            kept = f" w[{to[0]}] = t{k};" if k in needed else ""
            line = f"V t{k} = {value_of(function, k, here)};{kept}\n"
            here[to[0]] = f"t{k}"
        parts[-1].append(line)
    return parts


def told_in(function: ca.Function, to: list[int], value: str) -> str:
    """An entry of an output takes a value, in C."""
    number, entry = to
    if function.name_out(number).startswith(BESIDE):
        return f"put({value}, res[{number}] + {entry} * LANES);\n"
    return f"if (res[{number}]) scattered({value}, res[{number}] + {entry}, {function.numel_out(number)});\n"


def instruction_of(function: ca.Function, k: int) -> tuple[int, list[int], list[int]]:
    """Operation, where its result goes and what it takes: slots of the work vector, or which input or output."""
    return function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)


def needed_later(function: ca.Function, starts: list[int]) -> set[int]:
    """Instructions whose results are used in a later part than their own, of parts that begin so."""
    made: dict[int, int] = {}
    needed = set()
    for k in range(function.n_instructions()):
        operation, to, of = instruction_of(function, k)
        if operation not in (ca.OP_INPUT, ca.OP_CONST):
            begun = starts[bisect.bisect(starts, k) - 1]
            needed |= {made[slot] for slot in of if made[slot] < begun}
        if operation != ca.OP_OUTPUT:
            made[to[0]] = k
    return needed


def _shared(function: ca.Function, number: int) -> bool:
    return bool(function.name_in(number).startswith(SAME))


def name_of(slot: int, here: dict[int, str]) -> str:
    """Where the number in a slot of the work vector is, in C. here: names of those that this part has made."""
    return here.get(slot, f"w[{slot}]")


def value_of(function: ca.Function, k: int, here: dict[int, str]) -> str:
    """What instruction k finds, in C."""
    operation, _, of = instruction_of(function, k)
    if operation == ca.OP_CONST:
        return f"all({number_in_c(function.instruction_constant(k))})"
    if operation == ca.OP_INPUT and _shared(function, of[0]):
        return f"all(arg[{of[0]}][{of[1]}])"
    if operation == ca.OP_INPUT and function.name_in(of[0]).startswith(BESIDE):
        return f"taken(arg[{of[0]}] + {of[1]})"
    if operation == ca.OP_INPUT:
        return f"gathered(arg[{of[0]}] + {of[1]}, {function.numel_in(of[0])})"
    names = [name_of(slot, here) for slot in of]
    if operation in OPERATIONS:
        return OPERATIONS[operation].format(*names)
    return f"by_lane_{BY_LANE[operation]}({', '.join(names)})"


def interface(function: ca.Function, body: str, lanes: int) -> str:
    """The functions that casadi.external looks for, around the body of that which evaluates."""
    of_lanes = [1 if _shared(function, i) else lanes for i in range(function.n_in())]
    sizes_in = [(*function.size_in(i), times) for i, times in enumerate(of_lanes)]
    sizes_out = [(*function.size_out(i), lanes) for i in range(function.n_out())]
    return for_casadi(function.name(), body, sizes_in, sizes_out)


def for_casadi(name: str, body: str, sizes_in: Sizes, sizes_out: Sizes) -> str:
    """The same of a function of that name and such dense inputs and outputs."""
    return f"""\
int {name}(const double **arg, double **res, long long *iw, double *w, int mem) {{
{body}}}
long long {name}_n_in(void) {{ return {len(sizes_in)}; }}
long long {name}_n_out(void) {{ return {len(sizes_out)}; }}
{_sparsities(f"{name}_sparsity_in", sizes_in)}{_sparsities(f"{name}_sparsity_out", sizes_out)}"""


def _sparsities(name: str, sizes: Sizes) -> str:
    rows = ", ".join(f"{{{rows}, {times * columns}, 1}}" for rows, columns, times in sizes)
    return (
        f"const long long *{name}(long long i) {{\n    static const long long dense[][3] = {{{rows}}};\n"
        f"    return dense[i];\n}}\n"
    )
