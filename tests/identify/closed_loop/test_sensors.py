"""Sensors: values by other ways to them, and slopes against finite differences."""

import numpy as np
import pytest

from ctr_nlp.exceptions import OptionError
from ctr_nlp.identify.closed_loop.sensors import SensedShape, Sensors
from ctr_nlp.identify.closed_loop.sensors.fibre import FibreSensor
from ctr_nlp.identify.closed_loop.sensors.points import ShapePointSensor, TipPoseSensor, TipPositionSensor
from ctr_nlp.identify.closed_loop.sensors.views import ViewSensor, view

PAIR = np.array(
    [
        view(np.array(source), np.array([0.0, 0.0, 60.0]), np.array([0.0, 0.0, 1.0]))
        for source in ([900.0, 0.0, 60.0], [0.0, -800.0, 60.0])
    ]
)
PLACES = 0.2, 0.5, 0.9
EVERY = {
    "tip": TipPositionSensor(0.5),
    "pose": TipPoseSensor(0.5, 0.02),
    "points": ShapePointSensor(PLACES),
    "views": ViewSensor(PLACES, PAIR),
    "fibre": FibreSensor(PLACES),
}


def shape(bend, sigma, length=80.0):
    """An arc in a plane that is turned: curvature and turn are the variables; points and tangents at sigma."""
    curvature, turn = bend
    s = sigma * length * curvature
    aside, along = (1 - np.cos(s)) / curvature, np.sin(s) / curvature
    out = np.array([np.cos(turn), np.sin(turn), 0.0])
    points = aside[:, None] * out + np.outer(along, [0, 0, 1])
    return points, np.sin(s)[:, None] * out + np.outer(np.cos(s), [0, 0, 1])


def seen(sigma, bend=(0.012, 0.4), step=1e-6):
    slopes = []
    for k in range(2):
        ends = []
        for side in (1, -1):
            moved = list(bend)
            moved[k] += side * step
            ends.append(shape(moved, sigma))
        slopes.append([(a - b) / (2 * step) for a, b in zip(*ends, strict=True)])
    return SensedShape(*shape(bend, sigma), *(np.array([each[i] for each in slopes]) for i in range(2)), 80.0)


@pytest.mark.parametrize("name", EVERY)
def test_slopes_match_finite_differences(name):
    sensor, step = EVERY[name], 1e-5
    found = sensor.slopes(seen(sensor.sigma))
    for k, scale in enumerate((1e-3, 1.0)):
        bend = np.array([0.012, 0.4])
        change = np.eye(2)[k] * step * scale
        ends = [sensor.values(seen(sensor.sigma, bend + side * change)) for side in (1, -1)]
        assert found[:, k] == pytest.approx((ends[0] - ends[1]) / (2 * step * scale), rel=1e-4, abs=1e-4)
    assert found.shape == (len(sensor.noise), 2)


def test_a_view_shows_its_centre_in_the_middle_and_true_sizes_there():
    centre = np.array([0.0, 0.0, 60.0])
    found = view(np.array([900.0, 0.0, 60.0]), centre, np.array([0.0, 0.0, 1.0]), 2.0)
    for aside, there in (([0, 0, 0], (0, 0)), ([0, 0, 3], (0, 6)), ([0, 5, 0], (10, 0))):
        x, y, w = found @ np.append(centre + aside, 1.0)
        assert (x / w, y / w) == pytest.approx(there)


def test_two_views_tell_where_a_point_is():
    point = np.array([[7.0, -4.0, 66.0]])
    places = (
        ViewSensor((0.5,), PAIR).values(SensedShape(point, point, point[None], point[None], 80.0)).reshape(2, 2)
    )
    rows = np.vstack([p[:2] - np.outer(place, p[2]) for p, place in zip(PAIR, places, strict=True)])
    found, *_ = np.linalg.lstsq(rows[:, :3], -rows[:, 3], rcond=None)
    assert found == pytest.approx(point[0])


def test_a_fibre_measures_the_curvature_of_an_arc():
    fibre = FibreSensor(tuple(np.linspace(0, 1, 41)))
    assert fibre.values(seen(fibre.sigma)) == pytest.approx(0.012, rel=1e-3)


def test_several_sensors_are_one_whose_groups_belong_together():
    both = Sensors(EVERY["fibre"], EVERY["points"], EVERY["views"])
    at = seen(both.sigma)
    parts = [EVERY[name].values(seen(EVERY[name].sigma)) for name in ("fibre", "points", "views")]
    assert both.values(at) == pytest.approx(np.concatenate(parts))
    rows = np.concatenate([rows.ravel() for rows in both.value_groups])
    assert sorted(rows) == list(range(len(both)))
    assert {rows.shape[1] for rows in both.value_groups} == {1, 2, 3}


@pytest.mark.parametrize(
    ("make", "what"),
    [
        (lambda: TipPositionSensor(0.0), "deviation"),
        (lambda: ShapePointSensor((0.5, 1.2)), r"sigma.*\[0, 1\]"),
        (lambda: FibreSensor((0.5,)), "two places"),
        (lambda: Sensors(), "Sensor"),
        (lambda: view(np.zeros(3), np.zeros(3), np.array([0, 0, 1.0])), "source"),
    ],
)
def test_what_is_no_sensor_is_refused(make, what):
    with pytest.raises(OptionError, match=what):
        make()
