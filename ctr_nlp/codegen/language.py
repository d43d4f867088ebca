"""The C in which functions are written: for single numbers, or for vectors with one frame in each lane.

Both kinds define the same names (V, all, gathered, ...), so that the same generated text is code for one frame or
for VECTOR_LANES frames. Vectors use GCC's vector extension, which clang knows, too.
"""

from __future__ import annotations

import os
from collections.abc import Iterable

import casadi as ca

VECTOR_LANES = 8
"""Number of frames in a vector: what AVX-512 holds; compilers take two or four vectors where they are shorter."""
QUICK_COMPILE_VARIABLE = "CTR_NLP_QUICK"
"""Environment variable: 1 compiles long straight code of numbers as that of vectors, in half of the time."""
_QUICK_PRAGMA = '#pragma GCC optimize("Og")\n'
"""Long straight code of numbers compiles fastest so, and is a fifth slower than with more."""
_VECTOR_OPTIMISATION_PRAGMA = '#pragma GCC optimize("O1", "expensive-optimizations")\n'
"""Long straight code of vectors gains nothing from more. With less there are no instructions that multiply and add
with one rounding.
"""
FULL_OPTIMISATION_PRAGMA = '#pragma GCC optimize("O3")\n'
"""Short loops over frames gain from every optimisation."""
_LEAN_OPTIMISATION_PRAGMAS = "".join(
    f'#pragma GCC optimize("no-tree-{name}")\n' for name in ("slp-vectorize", "slsr", "pre", "dse")
)
"""Long straight code of numbers gains nothing from these, and compiles in 65 % of the time without them."""
_HELPER_OPTIMISATION_PRAGMAS = '#pragma GCC push_options\n#pragma GCC optimize("O2")\n{}#pragma GCC pop_options\n'
"""Loops over lanes gain from these optimisations, which the rest of the file is compiled without."""
_SCALAR = """\
#include <math.h>
typedef double V;
typedef int M;
static inline V gathered(const double *a, long step) { return a[0]; }
static inline void scattered(V a, double *to, long step) { to[0] = a; }
static inline V taken(const double *a) { return a[0]; }
static inline void put(V a, double *to) { to[0] = a; }
static inline V all(double a) { return a; }
static inline V masked(M m, V a) { return m ? a : 0.0; }
static inline V choose(M m, V a, V b) { return m ? a : b; }
static inline V one_where(M m) { return m; }
"""
"""Names of the language for one frame: V is a double."""
_SINES = """\
#include <math.h>
#ifdef LIBMVEC
#define SIMD _Pragma("omp simd simdlen(LANES)")
__attribute__((simd("notinbranch"))) double sin(double);
__attribute__((simd("notinbranch"))) double cos(double);
#else
#define SIMD
#endif
"""
"""Declarations that let the compiler call glibc's vector library for sines and cosines, where it is linked."""
_VECTOR = """\
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
"""Names of the language for vectors: V has a double for each lane, M an integer mask, and `gathered`, `scattered`
read and write entries of different frames, whose numbers lie `step` apart.
"""

_WAVES = """\
#pragma GCC push_options
#pragma GCC optimize("O2")
static __attribute__((noinline)) V far_sine_and_cosine(V a, V *cosine) {
    V sine;
    EACH sine[l] = sin(a[l]), (*cosine)[l] = cos(a[l]);
    return sine;
}
static __attribute__((noinline)) V sine_and_cosine(V a, V *cosine) {
    const double shift = 0x1.8p52;
    M far = ~((a < 1e6) & (a > -1e6));
    long long any = 0;
    EACH any |= far[l];
    if (__builtin_expect(any != 0, 0)) return far_sine_and_cosine(a, cosine);
    V turns = a * 0x1.45f306dc9c883p-1 + shift;
    M quarter = (M)turns;
    turns -= shift;
    V r = a - turns * 0x1.921fb544p+0 - turns * 0x1.0b4611a6p-34, rest = turns * 0x1.3198a2e037073p-69;
    V x = r - rest, low = (r - x) - rest, z = x * x;
    V s = x + (low + x * z * (-1.66666666666666324348e-01 + z * (8.33333333332248946124e-03 +
        z * (-1.98412698298579493134e-04 + z * (2.75573137070700676789e-06 +
        z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10))))));
    V half = 0.5 * z, one = 1.0 - half;
    V c = one + (((1.0 - one) - half) + (z * z * (4.16666666666666019037e-02 +
        z * (-1.38888888888741095749e-03 + z * (2.48015872894767294178e-05 +
        z * (-2.75573143513906633035e-07 + z * (2.08757232129817482790e-09 +
        z * -1.13596475577881948265e-11))))) - x * low));
    M odd = -(quarter & 1), sign = (M)all(-0.0);
    *cosine = (V)((M)choose(odd, s, c) ^ (((quarter + 1) << 62) & sign));
    return (V)((M)choose(odd, c, s) ^ ((quarter << 62) & sign));
}
static inline V by_lane_sin(V a) { V cosine; return sine_and_cosine(a, &cosine); }
static inline V by_lane_cos(V a) { V cosine; sine_and_cosine(a, &cosine); return cosine; }
#pragma GCC pop_options
"""
"""Sines and cosines of vectors, both at once, within 2 units in the last place.

The argument is reduced by the nearest multiple of pi/2, in three parts (Cody and Waite), the first two with so few
digits that products are exact; polynomials and the order of sums are those of Sun's fdlibm, k_sin.c and k_cos.c.
Beyond 1e6 the C library is called lane by lane.
"""

OPERATIONS = {
    ca.OP_ADD: "{0} + {1}",
    ca.OP_SUB: "{0} - {1}",
    ca.OP_MUL: "{0} * {1}",
    ca.OP_DIV: "{0} / {1}",
    ca.OP_NEG: "-{0}",
    ca.OP_SQ: "{0} * {0}",
    ca.OP_TWICE: "{0} + {0}",
    ca.OP_INV: "1.0 / {0}",
    # GCC's comparisons of vectors give masks (all bits or none); CasADi wants 1 or 0.
    ca.OP_LT: "one_where({0} < {1})",
    ca.OP_LE: "one_where({0} <= {1})",
    ca.OP_EQ: "one_where({0} == {1})",
    ca.OP_NE: "one_where({0} != {1})",
    ca.OP_NOT: "one_where({0} == 0.0)",
    ca.OP_AND: "one_where(({0} != 0.0) & ({1} != 0.0))",
    ca.OP_OR: "one_where(({0} != 0.0) | ({1} != 0.0))",
    # Masking bits instead of multiplying by 0 or 1: a value that is not chosen may be infinite or NaN.
    ca.OP_IF_ELSE_ZERO: "masked({0} != 0.0, {1})",
    # C's fmin for numbers: NaN is ignored where the other is a number. {1} != {1} is true for NaN only.
    ca.OP_FMIN: "choose(({0} < {1}) | ({1} != {1}), {0}, {1})",
    ca.OP_FMAX: "choose(({0} > {1}) | ({1} != {1}), {0}, {1})",
    # sign(NaN) is NaN, and sign(0) is 0.
    ca.OP_SIGN: "choose({0} != {0}, {0}, one_where({0} > 0.0) - one_where({0} < 0.0))",
}
"""Operations that C has for vectors as for numbers, in terms of their arguments {0} and {1}."""
C_LIBRARY_FUNCTIONS = {
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
"""Operations that are functions of the C library, called lane by lane."""
TWO_ARGUMENT_FUNCTIONS = "atan2", "pow", "copysign"
"""The functions of C_LIBRARY_FUNCTIONS with two arguments."""
WAVES = {"sin", "cos"}
"""The functions of C_LIBRARY_FUNCTIONS that vectors compute together."""
SHARED_C_NAMES = (
    *("V", "M", "gathered", "scattered", "taken", "put", "all", "masked", "choose", "one_where"),
    *(f"by_lane_{called}" for called in sorted(set(C_LIBRARY_FUNCTIONS.values()))),
)
"""Names that code for numbers and code for vectors both define; renamed where both are in one file."""


def file_header(operations: Iterable[int], lanes: int | None) -> str:
    """Return the beginning of a file with these operations.

    lanes: frames in a vector; 1 for numbers; None for loops over any number of frames, which take numbers.
    """
    return optimisation_pragmas(lanes) + definitions(operations, lanes)


def definitions(operations: Iterable[int], lanes: int | None) -> str:
    """Return C that defines the names of the language and these operations.

    lanes: as in file_header.
    """
    width = lanes or 1
    called = {C_LIBRARY_FUNCTIONS[operation] for operation in set(operations) & C_LIBRARY_FUNCTIONS.keys()}
    waves = _WAVES if width > 1 and called & WAVES else ""
    helpers = {_by_lane(name, width) for name in (called - WAVES if waves else called)}
    # Files of long vector code are compiled with little effort; the short loops over lanes gain from more.
    if width > 1:
        helpers = {_HELPER_OPTIMISATION_PRAGMAS.format(helper) for helper in helpers}
    # Code for one frame calls the C library itself; loops over frames need VECTOR_LANES, too.
    sines = "" if lanes == 1 else f"#define LANES {lanes or VECTOR_LANES}\n{_SINES}"
    begin = _SCALAR if width == 1 else _VECTOR % _unroll_lanes(width)
    return "".join([sines, begin, waves, *sorted(helpers)])


def _unroll_lanes(lanes: int) -> dict[str, str]:
    """Return expressions written out lane by lane: with few optimisations, compilers do not unroll short loops."""
    return {
        "gathered": ", ".join(f"a[{lane} * step]" for lane in range(lanes)),
        "scattered": " ".join(f"to[{lane} * step] = a[{lane}];" for lane in range(lanes)),
    }


def number_in_c(number: float) -> str:
    """Return a number in C; repr has all digits, so that it is read as the same number."""
    written = repr(number)
    return {"inf": "INFINITY", "-inf": "-INFINITY", "nan": "NAN"}.get(written, written)


def optimisation_pragmas(lanes: int | None) -> str:
    """Return the pragmas of optimisation; lanes: None for loops over any number of frames."""
    if lanes is None:
        return FULL_OPTIMISATION_PRAGMA
    if lanes > 1:
        return _VECTOR_OPTIMISATION_PRAGMA
    return _QUICK_PRAGMA if os.environ.get(QUICK_COMPILE_VARIABLE) == "1" else _LEAN_OPTIMISATION_PRAGMAS


def _by_lane(called: str, lanes: int) -> str:
    """Return a C library function for vectors; with a vector library, one call computes all lanes."""
    names = "ab" if called in TWO_ARGUMENT_FUNCTIONS else "a"
    parameters = ", ".join(f"V {name}" for name in names)
    # A number needs no loop over lanes: the C library is called in place.
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
