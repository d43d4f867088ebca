"""CasADi functions as C that evaluates several frames at once, a frame in each lane of the processor's vectors.

CasADi's own C takes one frame after the other, in one body that compilers need minutes for. Here every number is
a vector, and the body comes in parts, so that compilers' time grows in proportion.
"""

from __future__ import annotations

import bisect
import os

import casadi as ca

LANES = 8
"""Frames in a vector: what AVX-512 holds; compilers take two or four vectors where they are shorter."""
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

QUICK = "CTR_NLP_QUICK"
"""Environment variable: 1 compiles long straight code of numbers as that of vectors, in half of the time."""
_QUICK = '#pragma GCC optimize("Og")\n'
"""Long straight code of vectors gains a tenth at most from more, that of numbers a fifth."""
_LEAN = "".join(f'#pragma GCC optimize("no-tree-{name}")\n' for name in ("slp-vectorize", "slsr", "pre", "dse"))
"""Long straight code of numbers gains nothing from these, and compiles in 65 % of the time without them."""
_OPTIMIZED = '#pragma GCC push_options\n#pragma GCC optimize("O2")\n{}#pragma GCC pop_options\n'
"""Loops over lanes do."""
_SCALAR = """\
#include <math.h>
typedef double V;
typedef int M;
static inline V gathered(const double *a, long step) { return a[0]; }
static inline void scattered(V a, double *to, long step) { to[0] = a; }
static inline V all(double a) { return a; }
static inline V masked(M m, V a) { return m ? a : 0.0; }
static inline V choose(M m, V a, V b) { return m ? a : b; }
static inline V one_where(M m) { return m; }
"""
_VECTOR = """\
#include <math.h>
#ifdef LIBMVEC
#define SIMD _Pragma("omp simd simdlen(LANES)")
__attribute__((simd("notinbranch"))) double sin(double);
__attribute__((simd("notinbranch"))) double cos(double);
#else
#define SIMD
#endif
#define EACH for (int l = 0; l < LANES; ++l)
typedef double V __attribute__((vector_size(8 * LANES)));
typedef long long M __attribute__((vector_size(8 * LANES)));
static inline V gathered(const double *a, long step) { return (V){%(gathered)s}; }
static inline void scattered(V a, double *to, long step) { %(scattered)s }
typedef double Beside __attribute__((vector_size(8 * LANES), aligned(8)));
static inline V taken(const double *a) { return *(const Beside *)a; }
static inline void put(V a, double *to) { *(Beside *)to = a; }
static inline V all(double a) { return a - (V){0}; }
static inline V masked(M m, V a) { return (V)(m & (M)a); }
static inline V choose(M m, V a, V b) { return (V)((m & (M)a) | (~m & (M)b)); }
static inline V one_where(M m) { return masked(m, all(1.0)); }
"""

_OPERATIONS = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {0}",
    ca.OP_LT: "one_where({0} < {1})",
    ca.OP_LE: "one_where({0} <= {1})",
    ca.OP_EQ: "one_where({0} == {1})",
    ca.OP_NE: "one_where({0} != {1})",
    ca.OP_NOT: "one_where({0} == 0.0)",
    ca.OP_AND: "one_where(({0} != 0.0) & ({1} != 0.0))",
    ca.OP_OR: "one_where(({0} != 0.0) | ({1} != 0.0))",
    ca.OP_IF_ELSE_ZERO: "masked({0} != 0.0, {1})",
    ca.OP_FMIN: "choose(({0} < {1}) | ({1} != {1}), {0}, {1})",
    ca.OP_FMAX: "choose(({0} > {1}) | ({1} != {1}), {0}, {1})",
    ca.OP_SIGN: "choose({0} != {0}, {0}, one_where({0} > 0.0) - one_where({0} < 0.0))",
}
"""What the language has for vectors."""
_BY_LANE = {
    ca.OP_FABS: "fabs",
    ca.OP_SQRT: "sqrt",
    ca.OP_SIN: "sin",
    ca.OP_COS: "cos",
    ca.OP_TAN: "tan",
    ca.OP_ASIN: "asin",
    ca.OP_ACOS: "acos",
    ca.OP_ATAN: "atan",
    ca.OP_SINH: "sinh",
    ca.OP_COSH: "cosh",
    ca.OP_TANH: "tanh",
    ca.OP_EXP: "exp",
    ca.OP_LOG: "log",
    ca.OP_FLOOR: "floor",
    ca.OP_CEIL: "ceil",
    ca.OP_ATAN2: "atan2",
    ca.OP_POW: "pow",
    ca.OP_CONSTPOW: "pow",
    ca.OP_COPYSIGN: "copysign",
}
"""What the C library has for numbers."""
DEFINED = (
    *("V", "M", "gathered", "scattered", "all", "masked", "choose", "one_where"),
    *(f"by_lane_{called}" for called in sorted(set(_BY_LANE.values()))),
)
"""Names that code for numbers and code for vectors both define."""


def vector_code(functions: tuple[ca.Function, ...], lanes: int = LANES) -> str:
    """A file of C for functions with dense inputs and outputs.

    Operations that are repeated are done once. casadi.external loads them under their names; inputs and outputs
    have `lanes` times the columns, as those of `function.map(lanes)`, but for inputs whose names begin with SAME.
    With one lane numbers are numbers. Raises NotImplementedError for operations without C.
    """
    functions = tuple(_without_repetition(function) for function in functions)
    used = {function.instruction_id(k) for function in functions for k in range(function.n_instructions())}
    if unknown := used - _OPERATIONS.keys() - _BY_LANE.keys() - {ca.OP_CONST, ca.OP_INPUT, ca.OP_OUTPUT}:
        names = ", ".join(function.name() for function in functions)
        raise NotImplementedError(f"{names}: operations (numbers {sorted(unknown)}) without C")
    helpers = {_by_lane(_BY_LANE[operation], lanes) for operation in used & _BY_LANE.keys()}
    head = _SCALAR if lanes == 1 else f"#define LANES {lanes}\n{_VECTOR % _each(lanes)}"
    if lanes > 1:
        helpers = {_OPTIMIZED.format(helper) for helper in helpers}
    return "".join(
        [
            effort(lanes),
            head,
            *sorted(helpers),
            *(_function(function, lanes) for function in functions),
        ]
    )


def _each(lanes: int) -> dict[str, str]:
    """What is written lane by lane, since compilers leave short loops in code that they compile quickly."""
    return {
        "gathered": ", ".join(f"a[{lane} * step]" for lane in range(lanes)),
        "scattered": " ".join(f"to[{lane} * step] = a[{lane}];" for lane in range(lanes)),
    }


def effort(lanes: int) -> str:
    """How hard the compiler is to try, as C."""
    return _LEAN if lanes == 1 and os.environ.get(QUICK) != "1" else _QUICK


def _without_repetition(function: ca.Function) -> ca.Function:
    """The same function with each operation on the same numbers done once."""
    inputs = [ca.SX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
    names = function.name_in(), function.name_out()
    return ca.Function(function.name(), inputs, function.call(inputs), *names, {"cse": True})


def _by_lane(called: str, lanes: int) -> str:
    """A function of the C library for vectors; all lanes in one call where a library offers that."""
    names = "ab" if called in ("atan2", "pow", "copysign") else "a"
    parameters = ", ".join(f"V {name}" for name in names)
    if lanes == 1:
        return f"static inline V by_lane_{called}({parameters}) {{ return {called}({', '.join(names)}); }}\n"
    pointers = ", ".join(f"const double *restrict {name}" for name in names)
    return f"""\
static __attribute__((noinline)) void lanes_{called}({pointers}, double *restrict found) {{
    SIMD EACH found[l] = {called}({", ".join(f"{name}[l]" for name in names)});
}}
static inline V by_lane_{called}({parameters}) {{
    V found;
    lanes_{called}({", ".join(f"(const double *)&{name}" for name in names)}, (double *)&found);
    return found;
}}
"""


def _function(function: ca.Function, lanes: int) -> str:
    name, pause = function.name(), _pause(function)
    parts = _parts(function, pause)
    bodies = "".join(
        f"static __attribute__((noinline)) void {name}_{k}"
        f"(const double *const *arg, double *const *res, V *w) {{\n{''.join(part)}}}\n"
        for k, part in enumerate(parts)
    )
    calls = [f"    {name}_{k}(arg, res, v);\n" for k in range(len(parts))]
    if pause:
        calls.insert(-(-pause // PART), f"    {name}_pause(arg, res);\n")
    return bodies + _interface(function, "".join(calls), lanes)


def _pause(function: ca.Function) -> int:
    """How many instructions come until all early outputs have been found; 0 where there are none."""
    early = sum(function.name_out(i).startswith(EARLY) for i in range(function.n_out()))
    outputs = (k for k in range(function.n_instructions()) if function.instruction_id(k) == ca.OP_OUTPUT)
    return max((k + 1 for k in outputs if function.instruction_output(k)[0] < early), default=0)


def _starts(function: ca.Function, pause: int) -> list[int]:
    """The instructions with which parts begin; one of them is that after a pause."""
    return [*range(0, pause, PART), *range(pause, function.n_instructions(), PART)]


def _parts(function: ca.Function, pause: int) -> list[list[str]]:
    """The body, part by part: numbers have names of their own, and go on to later parts in the work vector w."""
    starts = _starts(function, pause)
    needed = _needed_later(function, starts)
    parts: list[list[str]] = []
    here: dict[int, str] = {}
    for k in range(function.n_instructions()):
        if k in starts:
            parts.append([])
            here.clear()
        operation, to, of = _instruction(function, k)
        if operation == ca.OP_OUTPUT:
            line = _found(function, to, _name(of[0], here))
        else:
            kept = f" w[{to[0]}] = t{k};" if k in needed else ""
            line = f"V t{k} = {_value(function, k, here)};{kept}\n"
            here[to[0]] = f"t{k}"
        parts[-1].append(line)
    return parts


def _found(function: ca.Function, to: list[int], value: str) -> str:
    """An entry of an output takes a value."""
    number, entry = to
    if function.name_out(number).startswith(BESIDE):
        return f"put({value}, res[{number}] + {entry} * LANES);\n"
    return f"if (res[{number}]) scattered({value}, res[{number}] + {entry}, {function.numel_out(number)});\n"


def _instruction(function: ca.Function, k: int) -> tuple[int, list[int], list[int]]:
    """Operation, where its result goes and what it takes: slots of the work vector, or which input or output."""
    return function.instruction_id(k), function.instruction_output(k), function.instruction_input(k)


def _needed_later(function: ca.Function, starts: list[int]) -> set[int]:
    """Instructions whose results are used in a later part than their own, of parts that begin so."""
    made: dict[int, int] = {}
    needed = set()
    for k in range(function.n_instructions()):
        operation, to, of = _instruction(function, k)
        if operation not in (ca.OP_INPUT, ca.OP_CONST):
            begun = starts[bisect.bisect(starts, k) - 1]
            needed |= {made[slot] for slot in of if made[slot] < begun}
        if operation != ca.OP_OUTPUT:
            made[to[0]] = k
    return needed


def _shared(function: ca.Function, number: int) -> bool:
    return bool(function.name_in(number).startswith(SAME))


def _name(slot: int, here: dict[int, str]) -> str:
    return here.get(slot, f"w[{slot}]")


def _value(function: ca.Function, k: int, here: dict[int, str]) -> str:
    operation, _, of = _instruction(function, k)
    if operation == ca.OP_CONST:
        number = repr(function.instruction_constant(k))
        return f"all({ {'inf': 'INFINITY', '-inf': '-INFINITY', 'nan': 'NAN'}.get(number, number) })"
    if operation == ca.OP_INPUT and _shared(function, of[0]):
        return f"all(arg[{of[0]}][{of[1]}])"
    if operation == ca.OP_INPUT and function.name_in(of[0]).startswith(BESIDE):
        return f"taken(arg[{of[0]}] + {of[1]})"
    if operation == ca.OP_INPUT:
        return f"gathered(arg[{of[0]}] + {of[1]}, {function.numel_in(of[0])})"
    names = [_name(slot, here) for slot in of]
    if operation in _OPERATIONS:
        return _OPERATIONS[operation].format(*names)
    return f"by_lane_{_BY_LANE[operation]}({', '.join(names)})"


def _interface(function: ca.Function, calls: str, lanes: int) -> str:
    """The functions that casadi.external looks for, around the calls."""
    name, of_lanes = function.name(), [1 if _shared(function, i) else lanes for i in range(function.n_in())]
    sizes_in = [(*function.size_in(i), times) for i, times in enumerate(of_lanes)]
    sizes_out = [(*function.size_out(i), lanes) for i in range(function.n_out())]
    return f"""\
int {name}(const double **arg, double **res, long long *iw, double *w, int mem) {{
    V v[{function.sz_w()}];
{calls}    return 0;
}}
long long {name}_n_in(void) {{ return {len(sizes_in)}; }}
long long {name}_n_out(void) {{ return {len(sizes_out)}; }}
{_sparsities(f"{name}_sparsity_in", sizes_in)}{_sparsities(f"{name}_sparsity_out", sizes_out)}"""


def _sparsities(name: str, sizes: list[tuple[int, int, int]]) -> str:
    rows = ", ".join(f"{{{rows}, {times * columns}, 1}}" for rows, columns, times in sizes)
    return (
        f"const long long *{name}(long long i) {{\n    static const long long dense[][3] = {{{rows}}};\n"
        f"    return dense[i];\n}}\n"
    )
