"""The elastic model as one text for one structure of robots: C, or CUDA C++ for graphics cards.

The hand-written files in c/ and the generated functions are those of compiled.py, with one lane. Macros of
c/lanes.c replace what graphics cards do not have: arrays of variable length, and fast pointers to functions.
"""

from __future__ import annotations

import casadi as ca

from ctr_nlp.codegen.c_structures import describe_structures
from ctr_nlp.codegen.cache import read_c_files
from ctr_nlp.codegen.language import definitions
from ctr_nlp.codegen.vector import vector_code
from ctr_nlp.models.elastic.compiled import ELASTIC_C_FILES, KERNEL_OPERATIONS, symbolic
from ctr_nlp.robot.structure import Structure

ONE_ROBOT_C_FILES = (*ELASTIC_C_FILES, "c/each.c")
"""The files of C, in the order in which they are compiled as one."""
_PROCESSOR = """\
#define KERNEL
#define CONSTANT static const
#define EACH_ROBOT(row, rows) for (long row = 0; row < (rows); ++row)
"""
"""A processor goes through the robots one after the other."""
_CARD = """\
#define KERNEL extern "C" __global__
#define CONSTANT static __device__ const
#define EACH_ROBOT(row, rows) \\
    for (long row = blockIdx.x * (long)blockDim.x + threadIdx.x; row < (rows); row = (rows))
#define HUGE_VAL __longlong_as_double(0x7ff0000000000000LL)
#define NAN __longlong_as_double(0x7ff8000000000000LL)
#define INFINITY HUGE_VAL
#define all in_all_lanes
"""
"""A card has a thread for each robot and no header files, and CUDA has a function `all` of its own."""
_SIZES = """\
#define LANES 1
#define ONE_STRUCTURE
#define TUBES(e) {tubes}
#define ROWS(e) {rows}
#define AGAINST(e) {against}
#define VECTORS(e) {vectors}
#define TURNS(e) {turns}
#define FIRST(e) first_tubes
#define OTHER(e) other_tubes
#define STARTS(e) turn_starts
#define COLUMNS(e) turn_columns
#define CALL(e, function) generated_##function
#define RESERVE(name, count) V name[(count) + 1]
#define RELEASE(name)
#define generated_motors_beside generated_motors
{arrays}
"""


def write_source(structure: Structure, card: bool) -> str:
    """Return the text for robots of a structure, as CUDA C++ (card) or as C.

    Its entry points are `rest_of_each` and `motion_of_each` of c/each.c.
    """
    # The last vector function computes the motors of several robots at a time. A thread has a robot of its own,
    # for which the scalar one is there.
    made = symbolic(structure)
    functions = *made.scalar_functions, *made.vector_functions[:-1]
    renamed = tuple(_rename(function, f"generated_{function.name()}") for function in functions)
    # Transposed, as CasADi stores a matrix by columns and C reads these turns row by row: the starts of rows and
    # the columns of their entries are constants of the text.
    pattern = made.of.turns.T.sparsity()
    arrays = {
        "first_tubes": made.of.couples[0].tolist(),
        "other_tubes": made.of.couples[1].tolist(),
        "turn_starts": pattern.colind(),
        "turn_columns": pattern.row(),
    }
    sizes = _SIZES.format(
        tubes=structure.d,
        rows=made.of.couples.shape[1],
        against=made.of.second.shape[0],
        vectors=made.vectors,
        turns=pattern.nnz(),
        arrays="\n".join(
            # C has no arrays of length 0.
            f"CONSTANT long {name}[] = {{{', '.join(map(str, values)) or 0}}};"
            for name, values in arrays.items()
        ),
    )
    # The language is defined by the generated code already, and a second time would be an error.
    generated = vector_code(renamed, 1)
    missing = [
        line for line in definitions(KERNEL_OPERATIONS, 1).splitlines(keepends=True) if line not in generated
    ]
    files = read_c_files("ctr_nlp.models.elastic", *ONE_ROBOT_C_FILES)
    text = "".join([_CARD if card else _PROCESSOR, sizes, generated, *missing, files])
    return text if card else text + describe_structures(files)


def _rename(function: ca.Function, name: str) -> ca.Function:
    """Return a function under another name; names of inputs and outputs, which have a meaning, stay."""
    inputs = [ca.SX.sym(function.name_in(i), *function.size_in(i)) for i in range(function.n_in())]
    return ca.Function(name, inputs, function.call(inputs), function.name_in(), function.name_out())
