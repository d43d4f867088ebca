"""Tapes: any number of frames at once, in blocks, against CasADi's own evaluation."""

import casadi as ca
import numpy as np
import pytest

from ctr_nlp.codegen import batch_evaluator, cache, tape
from ctr_nlp.codegen.batch_evaluator import BatchEvaluator, load_tape_function
from ctr_nlp.codegen.tape import TAPE_BLOCK_FRAMES, tape_code
from ctr_nlp.codegen.vector import VECTOR_LANES

X, A = ca.SX.sym("x", 3), ca.SX.sym("a", 2, 2)
FUNCTION = ca.Function(
    "pair", [X, A], [ca.sumsqr(X) + ca.sin(X[0]), ca.vec(A @ A.T) * X[2], ca.if_else(X[1] < 0, X[0] / X[1], 7.5)]
)


def loaded(function):
    """A function as a tape."""
    code = tape_code((function,))
    return load_tape_function(function.name(), str(cache.library(code, lambda: code)))


def evaluated(function, *inputs):
    """Results of rows of inputs, each (T, entries)."""
    found = BatchEvaluator(function, len(inputs[0]))
    found.inputs[1][:] = inputs[1]
    return [each.copy() for each in found(inputs[0].ravel())]


@pytest.mark.parametrize(
    "rows",
    [
        1,
        2,
        VECTOR_LANES - 1,
        VECTOR_LANES,
        VECTOR_LANES + 1,
        TAPE_BLOCK_FRAMES - 1,
        TAPE_BLOCK_FRAMES,
        TAPE_BLOCK_FRAMES + 1,
        3 * TAPE_BLOCK_FRAMES + 5,
    ],
)
def test_any_number_of_rows_is_what_casadi_finds_of_each(rows):
    rng = np.random.default_rng(rows)
    x, a = rng.normal(size=(rows, 3)), rng.normal(size=(rows, 4))
    for one, other in zip(evaluated(loaded(FUNCTION), x, a), evaluated(FUNCTION, x, a), strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=1e-14)


def test_what_is_not_a_number_stays_in_its_row():
    """In the last block rows that are missing are the last one, in other blocks none is."""
    rows = TAPE_BLOCK_FRAMES + 3
    rng = np.random.default_rng(1)
    x, a = rng.normal(size=(rows, 3)), rng.normal(size=(rows, 4))
    before = evaluated(loaded(FUNCTION), x, a)[0]
    for row in (0, TAPE_BLOCK_FRAMES - 1, TAPE_BLOCK_FRAMES, rows - 1):
        changed = x.copy()
        changed[row, 2] = np.nan
        after = evaluated(loaded(FUNCTION), changed, a)[0]
        assert np.flatnonzero(np.isnan(after[:, 0])).tolist() == [row]
        np.testing.assert_array_equal(np.delete(after, row, 0), np.delete(before, row, 0))


def test_a_function_that_is_too_large_is_named(monkeypatch):
    """Its instructions would tell other slots than they mean."""
    monkeypatch.setattr(tape, "TAPE_OPERAND_BITS", 2)
    with pytest.raises(NotImplementedError, match=r"pair has numbers beyond 4"):
        tape_code((FUNCTION,))


def test_a_tape_without_memory_for_it_is_an_error_and_no_result(monkeypatch):
    function = loaded(FUNCTION)
    monkeypatch.setitem(batch_evaluator._tapes, function, lambda *given: 1)
    with pytest.raises(MemoryError):
        evaluated(function, np.ones((5, 3)), np.ones((5, 4)))
