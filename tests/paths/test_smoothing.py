"""Jagged paths evened out: within the bound, within the lumen, and to what purpose."""

import numpy as np
import pytest
from hypothesis import given
from scipy.spatial import cKDTree
from strategies import numbers, seeds

from ctr_nlp import curve_from_points, read_csv
from ctr_nlp.paths.points import smooth_points

S = np.linspace(0, 1, 300)
ARC = 80 * np.column_stack([1 - np.cos(1.5 * S), 0 * S, np.sin(1.5 * S)])


def jagged(seed, width=4.0, count=300, spread=0.4):
    """An arc of 120 mm whose points wander as those of VMTK's lines: steps of 0.001 to some 0.5 mm."""
    random = np.random.default_rng(seed)
    steps = np.exp(random.uniform(np.log(1e-3), np.log(0.5), count))
    along = np.cumsum(steps) / steps.sum()
    wander = np.zeros((count, 3))
    for k in range(1, count):
        wander[k] = wander[k - 1] * np.exp(-120 * steps[k] / steps.sum()) + random.normal(0, spread, 3) * steps[k]
    angle = 1.5 * along
    points = 80 * np.column_stack([1 - np.cos(angle), 0 * angle, np.sin(angle)]) + wander
    return points, width * (1 - 0.7 * along)


@given(numbers(0.01, 3.0), seeds)
def test_the_smoothed_path_and_the_room_around_it_stay_in_the_lumen(allowed, seed):
    """Each sphere around a place of the smoothed path lies within one of the lumen's own."""
    exact = curve_from_points(*jagged(seed))
    smooth = exact.smooth(allowed)
    dense = np.linspace(0, exact.length, 20_000)
    centres, radii = exact.point(dense), exact.radius(dense)
    s = np.linspace(0, smooth.length, 500)
    for place, radius in zip(smooth.point(s), smooth.radius(s), strict=True):
        assert (np.linalg.norm(centres - place, axis=1) + radius - radii).min() < 0.01
    assert (smooth.radius(s) >= 0.49 * radii.min()).all()
    assert smooth.deviation <= allowed
    assert smooth.deviation_share <= 0.5


@given(numbers(0.01, 3.0), seeds)
def test_the_bound_holds_between_points_too(allowed, seed):
    exact = curve_from_points(jagged(seed)[0])
    smooth = exact.smooth(allowed)
    dense = cKDTree(smooth.point(np.linspace(0, smooth.length, 50_000)))
    assert dense.query(exact.point(np.linspace(0, exact.length, 7_777)))[0].max() <= allowed + 1e-3


def test_a_jagged_line_of_many_points_becomes_what_it_was_taken_from():
    exact = curve_from_points(*jagged(0, count=2000))
    smooth = exact.smooth(0.5)
    s = np.linspace(0, smooth.length, 1000)
    assert exact.length > 130
    assert smooth.length == pytest.approx(120, abs=1)
    assert exact.curvature(np.linspace(0, exact.length, 3000)).max() > 1
    assert smooth.curvature(s).max() < 0.1


def test_more_smoothing_bends_less():
    exact = curve_from_points(jagged(1)[0])
    bends = []
    for allowed in (0.0, 0.1, 0.3, 1.0):
        curve = exact.smooth(allowed)
        bends.append(curve.curvature(np.linspace(0, curve.length, 2000)).max())
    assert (np.diff(bends) < 0).all()


def test_no_smoothing_is_the_curve_itself():
    exact = curve_from_points(ARC)
    assert exact.smooth(0.0) is exact


def test_a_narrow_place_is_kept_to_while_others_are_evened():
    points, _ = jagged(2)
    radius = np.where(np.linspace(0, 1, len(points)) < 0.5, 0.1, 10.0)
    exact = curve_from_points(points, radius)
    smooth = exact.smooth(0.4)
    moved = cKDTree(smooth.point(np.linspace(0, smooth.length, 20_000))).query(points)[0]
    assert moved[:140].max() <= 0.05
    assert moved[160:].max() > 0.1


def test_either_direction_is_smoothed_alike():
    exact = curve_from_points(*jagged(3))
    one, other = exact.smooth(0.3).reverse_direction(), exact.reverse_direction().smooth(0.3)
    s = np.linspace(0, one.length, 100)
    assert other.length == pytest.approx(one.length, abs=1e-6)
    assert other.point(s) == pytest.approx(one.point(s), abs=1e-4)


def test_a_straight_line_stays_where_it_is():
    points = np.outer(np.linspace(0, 100, 200), [0.0, 0.6, 0.8])
    assert smooth_points(points, np.full(200, 1.0)) == pytest.approx(points, abs=1e-6)


def test_points_on_two_sides_of_a_line_meet_on_it():
    """A zigzag of 1 mm and a bound that just allows to straighten it."""
    zigzag = np.column_stack([np.arange(100.0), np.where(np.arange(100) % 2, 0.5, -0.5), np.zeros(100)])
    assert np.abs(smooth_points(zigzag, np.full(100, 0.75))[:, 1]).max() < 0.3


@pytest.mark.parametrize("name", ["chaste_ts002_LLL", "chaste_ts002_RLL", "chaste_ts002_RML", "hra_vhm_left_main"])
def test_real_airways_lose_bends_and_little_room(shared_data, name):
    exact = read_csv(shared_data / "airways" / f"{name}.csv")
    smooth = exact.smooth(0.3)
    sharpest = [curve.curvature(np.linspace(0, curve.length, 2000)).max() for curve in (exact, smooth)]
    assert sharpest[1] < sharpest[0]
    assert 0 < smooth.deviation <= 0.3
    assert smooth.deviation_share < 0.2
