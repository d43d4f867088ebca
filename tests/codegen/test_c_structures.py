"""Structures of C that Python mirrors: a difference is noticed when the library is loaded."""

import ctypes

import pytest

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.c_structures import check_structure, describe_structures

SOURCE = """
typedef struct {
    int (*call)(const double *const *, long); /* what, is; called */
    const double *first, *second[2];
    long count; /* how many */
} Given;
"""


class Same(ctypes.Structure):
    _fields_ = [
        ("call", ctypes.c_void_p),
        ("first", ctypes.c_void_p),
        ("second", ctypes.c_void_p * 2),
        ("count", ctypes.c_long),
    ]


class Exchanged(ctypes.Structure):
    _fields_ = [Same._fields_[0], Same._fields_[3], *Same._fields_[1:3]]


class Shorter(ctypes.Structure):
    _fields_ = [*Same._fields_[:2], ("second", ctypes.c_void_p), Same._fields_[3]]


@pytest.fixture(scope="module")
def library():
    if cache.unavailable_reason():
        pytest.skip("no C compiler")
    code = SOURCE + describe_structures(SOURCE)
    return ctypes.CDLL(str(cache.library(code, lambda: code)))


def test_a_mirror_that_agrees_is_accepted(library):
    check_structure(library, "Given", Same)


@pytest.mark.parametrize("mirror", [Exchanged, Shorter])
def test_a_mirror_that_differs_is_refused_with_both_sides(library, mirror):
    with pytest.raises(
        RuntimeError,
        match=rf"struct Given has the fields call,first,second,count "
        rf".*{mirror.__name__}",
    ):
        check_structure(library, "Given", mirror)
