"""Functions with many sample points of one kind, as C: VECTOR_LANES points at a time, shared quantities once.

A whole function has three parts (ocp/partition.py): the main part, which computes shared quantities and all else
with slopes, a part for a sample point, called in between for VECTOR_LANES points at a time, and one that joins
both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import casadi as ca

from ctr_nlp.codegen.forward_mode import FunctionWithJacobian, forward_mode_code
from ctr_nlp.codegen.language import SHARED_C_NAMES, VECTOR_LANES
from ctr_nlp.codegen.tape import tape_code
from ctr_nlp.codegen.vector import EARLY_OUTPUT_PREFIX, casadi_entry_points, vector_code
from ctr_nlp.typing import Array

_AT_PLACES = """\
typedef int (*Place)(const double **, double **, long long *, double *, int);

/* Call a function for so many places, LANES at once, of which the last may be some that were had before. It is
   given inputs, what was found early, and constants. What is summed over all, and then each thing that is found of
   every one, go to `to`. */
static void at_places(Place one, const double **arg, long inputs, const double **early, long found_early,
                      const double *constants, long places, long sums, long rows, double *to) {
    double part[sums * LANES + 1], found[rows * LANES + 1], total[sums * LANES + 1], fresh[LANES];
    const double *given[2 * inputs + found_early + 2];
    double *into[] = {part, found};
    for (long k = 0; k < inputs; ++k) given[k] = arg[k];
    for (long k = 0; k < found_early; ++k) given[inputs + k] = early[k];
    given[2 * inputs + found_early + 1] = fresh;
    memset(total, 0, sizeof total);
    for (long next = 0; next < places; next += LANES) {
        long at = next < places - LANES ? next : places - LANES;
        for (long k = 0; k < inputs; ++k) given[inputs + found_early + k] = arg[k] + at;
        given[2 * inputs + found_early] = constants + at;
        for (long l = 0; l < LANES; ++l) fresh[l] = at + l >= next;
        one(given, into, 0, 0, 0);
        for (long k = 0; k < sums; ++k) *(Beside *)(total + k * LANES) += *(Beside *)(part + k * LANES);
        for (long k = 0; k < rows; ++k) *(Beside *)(to + sums + k * places + at) = *(Beside *)(found + k * LANES);
    }
    for (long k = 0; k < sums; ++k) {
        const double *a = total + k * LANES;
        to[k] = ((a[0] + a[4]) + (a[2] + a[6])) + ((a[1] + a[5]) + (a[3] + a[7]));
    }
}
"""
"""The loop over sample points in C. The last vector may overlap the one before; repeated points add 0 to sums."""


class SamplePointFunction(NamedTuple):
    """A function of one of many sample points of one kind, at least VECTOR_LANES of them.

    Its inputs are, with names that begin with SHARED_INPUT_PREFIX and shared by all points, the whole function's
    but the last and its early outputs; then, with names that begin with ADJACENT_LANES_PREFIX, those inputs again,
    constants (k, points), and whether a point counts, 1 or 0. Of the latter, an entry is that of the first point,
    and the number after it that of the next one. Its two outputs (ADJACENT_LANES_PREFIX) are the parts of sums
    over the points that count, and the results of each point.
    """

    function: ca.Function
    constants: Array

    @property
    def sizes(self) -> tuple[int, int, int]:
        """Numbers of sample points, of sums, and of results of each point."""
        return self.constants.shape[1], self.function.numel_out(0), self.function.numel_out(1)

    @property
    def numbers(self) -> int:
        """Count of numbers for the whole function: the sums, and then, for each result, those of all points."""
        places, sums, found = self.sizes
        return sums + found * places


class FunctionInParts(NamedTuple):
    """A function called `name`, in parts: one of the unknowns and other inputs, and one that joins all results.

    main_part: its last input are the results at sample points, which are evaluated in its pause, from its other
    inputs and early outputs with their slopes; outputs whose names begin with EARLY_OUTPUT_PREFIX come first.
    join_part: of the results at sample points and then those of the main part, in their order (forward_mode.py).
    """

    name: str
    main_part: FunctionWithJacobian
    sample_point_parts: tuple[SamplePointFunction, ...]
    join_part: ca.Function

    @property
    def early(self) -> list[int]:
        """Numbers of the main part's results that sample points take: early outputs, then their slopes."""
        function = self.main_part.function
        slopes = sorted(self.main_part.slopes)
        # Early results with wanted slopes have these after all outputs, in the order of the outputs'
        # numbers.
        early = [k for k in range(function.n_out()) if function.name_out(k).startswith(EARLY_OUTPUT_PREFIX)]
        return early + [function.n_out() + slopes.index(k) for k in early if k in slopes]


def code(functions: Sequence[ca.Function | FunctionInParts], lanes: int | None) -> str:
    """Return a C file for functions of `lanes` frames together, None for any number.

    Functions in parts are of one frame.
    """
    wholes = [each for each in functions if isinstance(each, FunctionInParts)]
    plain = tuple(each for each in functions if isinstance(each, ca.Function))
    # Only code for one frame has sample points in its lanes; tapes, for many frames, have frames there.
    if lanes is None:
        return tape_code(plain)
    if not wholes:
        return vector_code(plain, lanes)
    each = tuple(at.function for whole in wholes for at in whole.sample_point_parts)
    return "".join(
        [
            "#include <math.h>\n#include <string.h>\n#pragma GCC push_options\n",
            # Vector code for points and number code for the rest define the same names: the former's get
            # another ending, and its compiler options are undone afterwards.
            *(f"#define {name} {name}_beside\n" for name in SHARED_C_NAMES),
            vector_code(each, VECTOR_LANES),
            *(f"#undef {name}\n" for name in SHARED_C_NAMES),
            "#pragma GCC pop_options\n",
            _AT_PLACES,
            *(_sample_point_call(whole) for whole in wholes if whole.sample_point_parts),
            # The join needs no slopes: the same generator writes it, without any.
            forward_mode_code(
                [part for whole in wholes for part in (whole.main_part, FunctionWithJacobian(whole.join_part, {}))]
            ),
            *(_public_entry_point(whole) for whole in wholes),
        ]
    )


def _sample_point_call(whole: FunctionInParts) -> str:
    """Return C of the function that evaluates the sample points when all early outputs are known."""
    inputs = whole.main_part.function.n_in() - 1
    lines = list[str]()
    to = 0
    early = ", ".join(f"res[{k}]" for k in whole.early)
    for at in whole.sample_point_parts:
        sizes = ", ".join(map(str, at.sizes))
        # Constants of all points, constant after constant, so that neighbouring points are neighbours in
        # memory.
        numbers = ", ".join(map(repr, at.constants.ravel().tolist()))
        lines += [
            f"    {{\n        static const double constants[] = {{{numbers}}};\n",
            f"        at_places({at.function.name()}, arg, {inputs}, early, {len(whole.early)}, constants, "
            # The last input of the main part is filled here, before the rest of it is evaluated.
            f"{sizes}, (double *)arg[{inputs}] + {to});\n    }}\n",
        ]
        to += at.numbers
    return (
        f"static void {whole.main_part.function.name()}_pause(const double **arg, double **res) {{\n"
        f"    const double *early[] = {{{early}}};\n{''.join(lines)}}}\n"
    )


def _public_entry_point(whole: FunctionInParts) -> str:
    """Return C of the function as it is called from outside, and by casadi.external."""
    directed = whole.main_part.function
    joined = whole.join_part
    inputs = directed.n_in() - 1
    results = [f"found_{k}" for k in range(joined.n_in() - 1)]
    # C has no arrays of length 0.
    sizes = [max(joined.numel_in(k), 1) for k in range(joined.n_in())]
    room = ", ".join(f"{name}[{size}]" for name, size in zip(["places", *results], sizes, strict=True))
    given = ", ".join([*(f"arg[{k}]" for k in range(inputs)), "places"])
    body = f"""\
    double {room};
    const double *given[] = {{{given}}}, *all_found[] = {{places, {", ".join(results)}}};
    double *found[] = {{{", ".join(results)}}};
    {directed.name()}(given, found);
    {joined.name()}(all_found, res);
    return 0;
"""
    return casadi_entry_points(
        whole.name,
        body,
        [(*directed.size_in(k), 1) for k in range(inputs)],
        [(*joined.size_out(k), 1) for k in range(joined.n_out())],
    )
