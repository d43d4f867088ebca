"""Checks of points, radii and units that all readers of anatomy share."""

import numpy as np
import pytest

from ctr_nlp.anatomy.branch import Branch
from ctr_nlp.anatomy.plausibility import (
    check_reach,
    check_steps,
    drop_repeated_points,
    find_units,
    repair_radii,
)
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ASSUMED, GIVEN, STATED, FileFacts, ReadOptions
from ctr_nlp.exceptions import CurveError

ANGLE = np.linspace(0, 1.2, 61)
ARC = 90 * np.column_stack([1 - np.cos(ANGLE), 0 * ANGLE, np.sin(ANGLE)])
"""Points (61, 3) every 1.8 mm of an arc of 108 mm."""


def test_repeats_are_left_out_with_their_radius():
    twice = np.insert(ARC, 5, ARC[4], axis=0)
    found = drop_repeated_points(twice, np.arange(62.0))
    assert found.points == pytest.approx(ARC)
    assert found.radius.tolist() == [*range(5), *range(6, 62)]
    assert found.numbers.tolist() == [*range(1, 6), *range(7, 63)]
    assert found.notes == ("left out a point that repeats the one before it (6)",)


def test_a_good_path_has_no_notes():
    assert check_steps(ARC, AS_THE_FILE_SAYS) == ()


@pytest.mark.parametrize("shift", [1, 2, 20, 59, 60])
def test_a_path_that_begins_elsewhere_is_refused_with_both_points(shift):
    turned = np.roll(ARC, -shift, axis=0)
    with pytest.raises(
        CurveError, match=rf"points {61 - shift} \(.*\) and {62 - shift} \(0, 0, 0\) are .* mm apart"
    ):
        check_steps(turned, AS_THE_FILE_SAYS)
    assert "accepted" in check_steps(turned, ReadOptions(accept=("steps",)))[0]


def test_the_first_point_saved_last_names_its_likely_cause():
    with pytest.raises(CurveError, match=r"points 60 .* and 61 \(0, 0, 0\) .*SlicerVMTK before 2024"):
        check_steps(np.roll(ARC, -1, axis=0), AS_THE_FILE_SAYS)


@pytest.mark.parametrize("seed", range(20))
def test_points_in_any_other_order_are_refused(seed):
    random = np.random.default_rng(seed)
    with pytest.raises(CurveError, match="order"):
        check_steps(random.permutation(ARC), AS_THE_FILE_SAYS)
    k = int(random.integers(1, 57))
    with pytest.raises(CurveError, match="order"):
        check_steps(np.vstack([ARC[:k], ARC[k : k + 4][::-1], ARC[k + 4 :]]), AS_THE_FILE_SAYS)


def test_uneven_but_orderly_points_are_read():
    uneven = ARC[[0, 1, 2, 3, 8, 13, 20, 21, 22, 30, 38, 46, 54, 60]]
    check_steps(uneven, AS_THE_FILE_SAYS)
    assert "interpolated" in check_steps(np.delete(ARC, slice(20, 25), axis=0), AS_THE_FILE_SAYS)[0]


def test_noise_of_dense_points_is_no_reversal():
    dense = np.column_stack([np.zeros(1000), np.zeros(1000), np.linspace(0, 100, 1000)])
    dense += np.random.default_rng(0).normal(scale=0.05, size=dense.shape)
    assert check_steps(dense, AS_THE_FILE_SAYS) == ()


@pytest.mark.parametrize(("factor", "unit"), [(0.1, "cm"), (0.001, "m"), (1000, "um")])
@pytest.mark.parametrize("stated", [None, "mm"])
@pytest.mark.hazard("wrong unit")
def test_an_implausible_unit_is_refused_with_the_one_that_fits(factor, unit, stated):
    with pytest.raises(CurveError, match=rf"--units {unit}, or --units mm"):
        find_units(ARC * factor, AS_THE_FILE_SAYS, stated)
    given = find_units(ARC * factor, ReadOptions(units=unit), stated)
    assert (given.units, given.known, given.mm_per_unit * factor) == (unit, GIVEN, pytest.approx(1))
    assert find_units(ARC * factor, ReadOptions(units="mm")).mm_per_unit == 1


def test_stated_and_assumed_units_are_told_apart():
    assert find_units(ARC, AS_THE_FILE_SAYS).known == ASSUMED
    assert find_units(ARC / 10, AS_THE_FILE_SAYS, "cm").known == STATED
    assert find_units(10 * ARC, AS_THE_FILE_SAYS).notes


def test_a_path_is_held_against_the_reach_of_the_robot():
    long = Branch("", ARC)
    short = Branch("", ARC * 0.3, np.full(61, 2.0))
    thin = Branch("", ARC * 0.3, np.full(61, 0.3))
    assert check_reach(long, 150.0, 1.0, FileFacts()) == []
    assert check_reach(short, 150.0, 1.0, FileFacts(units_known=GIVEN)) == []
    assert "if the file is in cm, the path is 324 mm long" in check_reach(short, 150.0, 1.0, FileFacts())[0]
    with pytest.raises(CurveError, match=r"robot reaches 400 mm, but .* --units cm"):
        check_reach(short, 400.0, 1.0, FileFacts())
    with pytest.raises(CurveError, match=r"thinnest tube has a radius of 1 mm and the lumen 0\.3, .* --units cm"):
        check_reach(thin, 150.0, 1.0, FileFacts())
    check_reach(thin, 150.0, 0.2, FileFacts())


@pytest.mark.parametrize(("count", "shift"), [(7, 1), (7, 3), (12, 11), (20, 1)])
def test_few_points_that_begin_elsewhere_are_refused_with_the_cause(count, shift):
    few = ARC[np.linspace(0, 60, count).astype(int)]
    with pytest.raises(CurveError, match=r"mm apart.*: the (first|last) point lies"):
        check_steps(np.roll(few, -shift, axis=0), AS_THE_FILE_SAYS)


@pytest.mark.parametrize("absent", [0.0, np.nan])
def test_radii_are_unknown_repaired_or_refused(absent):
    radius = np.full(61, 3.0)
    assert repair_radii(radius)[1] == ()
    assert repair_radii(np.full(61, absent))[0] is None
    radius[[0, -1]] = absent
    repaired, notes = repair_radii(radius)
    assert repaired == pytest.approx(3.0)
    assert len(notes) == 2
    radius[30] = absent
    with pytest.raises(CurveError, match=r"radius at point 31 is (0|nan); radii must be positive"):
        repair_radii(radius)


@pytest.mark.parametrize("bad", [-1.0, np.inf])
def test_radii_that_are_no_radii_are_refused_at_an_end_too(bad):
    with pytest.raises(CurveError, match="point 1 is"):
        repair_radii(np.array([bad, 1, 1, 1]))
