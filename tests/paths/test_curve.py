"""Curves against closed forms, and centreline files good and bad."""

from __future__ import annotations

import contextlib
import math

import casadi as ca
import numpy as np
import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from strategies import numbers, rigid_transforms, seeds

from ctr_nlp import curve_from_formula, curve_from_points, read_csv
from ctr_nlp.exceptions import CurveError
from ctr_nlp.paths.placement import move_to_robot_frame, trim_curve

A, B = 20.0, 15.0
W = math.hypot(A, B)
ARC_LENGTHS = np.arange(0, 150.5, 1.0)


def helix_points(s):
    """Points (n, 3) of a helix of curvature A / W^2 at arc lengths s (n,)."""
    return np.stack([A * np.cos(s / W), A * np.sin(s / W), B * s / W], axis=1)


def circle_points(s, radius=60.0):
    return np.stack([radius * np.cos(s / radius), radius * np.sin(s / radius), 0 * s], axis=1)


SHAPES = {"helix": (helix_points, A / W**2), "circle": (circle_points, 1 / 60)}


def helix():
    return curve_from_formula(lambda u: (A * ca.cos(u), A * ca.sin(u), B * u), 0.0, 6.0)


def cosine():
    return curve_from_formula(lambda u: (10 * ca.cos(0.044 * u) - 10, 0, u), 0.0, 140.0)


def write(path, points, header="x_mm,y_mm,z_mm", decimals=9):
    rows = [",".join(f"{c:.{decimals}f}" for c in row) for row in points]
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def gap(curve, points):
    """Largest distance in mm from given points to the curve, sampled every 0.003 mm or so."""
    return cKDTree(curve.point(np.linspace(0, curve.length, 50_000))).query(points)[0].max()


# From formulas


@given(numbers(2, 500), numbers(0.3, 6))
def test_circle_has_constant_curvature_and_length_radius_times_angle(radius, angle):
    curve = curve_from_formula(lambda u: (radius * ca.cos(u), radius * ca.sin(u), 3), 0.0, angle)
    assert curve.length == pytest.approx(radius * angle, rel=1e-12)
    np.testing.assert_allclose(curve.curvature(np.linspace(0, curve.length, 50)), 1 / radius, rtol=1e-10)


def test_helix_points_and_tangents_are_at_their_arc_lengths():
    curve, s = helix(), np.linspace(0, 6 * W, 333)
    assert curve.length == pytest.approx(6 * W, rel=1e-13)
    np.testing.assert_allclose(curve.point(s), helix_points(s), atol=1e-8)
    expected = np.stack([-A * np.sin(s / W), A * np.cos(s / W), B + 0 * s], axis=1) / W
    np.testing.assert_allclose(curve.tangent(s), expected, atol=1e-9)


def test_helix_has_constant_curvature():
    curve = helix()
    np.testing.assert_allclose(curve.curvature(np.linspace(0, curve.length, 50)), A / W**2, rtol=1e-10)


@pytest.mark.parametrize("fraction", [0.1, 0.33, 0.5, 1.0])
def test_cosine_has_its_arc_length_and_curvature_at_a_parameter(fraction):
    curve, u = cosine(), 140 * fraction
    truth, _ = quad(lambda v: math.hypot(0.44 * math.sin(0.044 * v), 1), 0, u, epsabs=1e-12, limit=500)
    s = curve.length_at(fraction)
    assert s == pytest.approx(truth, abs=1e-9)
    k = 10 * 0.044**2 * abs(math.cos(0.044 * u)) / math.hypot(0.44 * math.sin(0.044 * u), 1) ** 3
    assert curve.curvature(np.array([s]))[0] == pytest.approx(k, rel=1e-6)


@pytest.mark.parametrize("ends", [(0, 0), (1, 0), (0, math.inf), (math.nan, 1)])
def test_a_parameter_range_that_does_not_grow_is_refused(ends):
    with pytest.raises(CurveError, match="range"):
        curve_from_formula(lambda u: (u, 0, 0), *ends)


def test_a_formula_that_stands_still_is_refused():
    with pytest.raises(CurveError, match="stands still"):
        curve_from_formula(lambda u: (ca.fmax(u, 5), 0, 0), 0.0, 10.0)


# From points


@pytest.mark.parametrize("kind", SHAPES)
@pytest.mark.parametrize(("decimals", "step"), [(9, 1), (4, 1), (1, 1), (9, 5)])
def test_a_file_is_followed_through_its_points(tmp_path, kind, decimals, step):
    points = SHAPES[kind][0](ARC_LENGTHS[::step])
    curve = read_csv(write(tmp_path / "path.csv", points, decimals=decimals))
    assert gap(curve, np.round(points, decimals)) < 0.01
    np.testing.assert_allclose(
        curve.point(np.array([0, curve.length])), np.round(points[[0, -1]], decimals), atol=1e-6
    )


@pytest.mark.parametrize("kind", SHAPES)
def test_a_files_curve_is_the_one_that_its_points_were_taken_from(tmp_path, kind):
    points, s = SHAPES[kind][0], np.linspace(0, 150, 700)
    curve = read_csv(write(tmp_path / "path.csv", points(ARC_LENGTHS)))
    assert curve.length == pytest.approx(150, abs=1e-4)
    np.testing.assert_allclose(curve.point(s), points(s), atol=1e-3)


@pytest.mark.parametrize("kind", SHAPES)
def test_curvature_of_a_file_agrees_away_from_its_ends(tmp_path, kind):
    points, k = SHAPES[kind]
    curve = read_csv(write(tmp_path / "path.csv", points(ARC_LENGTHS), decimals=6))
    np.testing.assert_allclose(curve.curvature(np.linspace(6, curve.length - 6, 300)), k, rtol=5e-3)


@pytest.mark.parametrize("kind", SHAPES)
def test_curvature_of_a_file_agrees_at_its_ends(tmp_path, kind):
    points, k = SHAPES[kind]
    curve = read_csv(write(tmp_path / "path.csv", points(ARC_LENGTHS), decimals=6))
    np.testing.assert_allclose(curve.curvature(np.array([0, curve.length])), k, rtol=0.1)


@pytest.mark.parametrize("kind", SHAPES)
def test_curvature_survives_coordinates_rounded_to_a_tenth_of_a_millimetre(tmp_path, kind):
    """Second differences of the rounded points alone would be wrong by several times the curvature itself."""
    points, k = SHAPES[kind]
    tilted = Rotation.from_euler("xyz", [0.3, -0.8, 0.5]).apply(points(ARC_LENGTHS))
    curve = read_csv(write(tmp_path / "path.csv", tilted, decimals=1))
    found = curve.curvature(np.linspace(10, curve.length - 10, 300))
    assert np.sqrt(np.mean((found / k - 1) ** 2)) < 0.25


def test_a_straight_file_has_no_curvature(tmp_path):
    curve = read_csv(write(tmp_path / "path.csv", np.outer(ARC_LENGTHS, [0.6, 0, 0.8])))
    assert curve.curvature(np.linspace(0, curve.length, 100)).max() < 1e-6


def test_unevenly_spaced_points_give_the_same_curve():
    s = np.concatenate([np.linspace(0, 30, 70), np.linspace(32, 90, 20), np.linspace(90.4, 150, 90)])
    curve, at = curve_from_points(helix_points(s)), np.linspace(0, 150, 500)
    np.testing.assert_allclose(curve.point(at), helix_points(at), atol=0.01)


@given(numbers(0.02, 2.0), seeds)
@example(0.5, 5883)
@example(0.5, 3768)
def test_smoothing_keeps_its_bound_and_reports_the_deviation(bound, seed):
    noise = np.random.default_rng(seed).normal(0, 0.3, (60, 3))
    points = helix_points(np.linspace(0, 150, 60)) + noise
    curve = curve_from_points(points, smoothing=bound)
    found = gap(curve, points)
    assert found <= bound + 1e-4
    assert found - 1e-4 <= curve.deviation <= bound


def test_smoothing_straightens_noise():
    noise = np.random.default_rng(0).normal(0, 0.2, (151, 3))
    points = helix_points(ARC_LENGTHS) + noise
    rough, smooth = curve_from_points(points), curve_from_points(points, smoothing=1.0)
    assert rough.deviation == 0
    assert smooth.length < rough.length
    assert smooth.length == pytest.approx(150, rel=0.02)


def test_radius_is_kept_at_the_given_points(tmp_path):
    radii = 4 + np.cos(ARC_LENGTHS / 20)
    table = np.column_stack([radii, helix_points(ARC_LENGTHS)])
    curve = read_csv(write(tmp_path / "path.csv", table, "radius_mm,x_mm,y_mm,z_mm"))
    np.testing.assert_allclose(curve.radius(ARC_LENGTHS), radii, atol=1e-3)


def test_a_byte_order_mark_blanks_and_capitals_are_read(tmp_path):
    path = tmp_path / "path.csv"
    rows = "\r\n".join(f"{x}, {y} ,{z}" for x, y, z in helix_points(ARC_LENGTHS))
    path.write_bytes(b"\xef\xbb\xbf" + f" X_mm, Y_MM ,z_mm\r\n\r\n{rows}\r\n\r\n".encode())
    assert read_csv(path).length == pytest.approx(150, abs=1e-3)


# Cut and moved


@given(rigid_transforms())
def test_moving_keeps_curvature_and_length(transform):
    curve = cosine()
    moved, s = curve.apply_transform(transform), np.linspace(0, curve.length, 60)
    steps = (np.linalg.norm(np.diff(c.point(s), axis=0), axis=1) for c in (moved, curve))
    np.testing.assert_allclose(moved.curvature(s), curve.curvature(s), rtol=1e-12)
    np.testing.assert_allclose(*steps, rtol=1e-9)
    np.testing.assert_allclose(moved.tangent(s), curve.tangent(s) @ transform[:3, :3].T, atol=1e-12)


def test_reversed_runs_from_last_to_first():
    curve = cosine()
    back, s = curve.reverse_direction(), np.linspace(0, curve.length, 40)
    np.testing.assert_allclose(back.point(s), curve.point(s[::-1]), atol=1e-9)
    np.testing.assert_allclose(back.tangent(s), -curve.tangent(s[::-1]), atol=1e-12)
    np.testing.assert_allclose(back.curvature(s), curve.curvature(s[::-1]), rtol=1e-9)


def test_reversed_turns_the_radius_too():
    radii = np.linspace(9, 3, len(ARC_LENGTHS))
    curve = curve_from_points(helix_points(ARC_LENGTHS), radii).reverse_direction()
    np.testing.assert_allclose(curve.radius(np.array([0.0, 75, 150])), [3, 6, 9], atol=1e-3)


def test_part_is_the_piece_between_two_arc_lengths():
    piece, s = helix().part(20, 50), np.linspace(0, 30, 31)
    assert piece.length == 30
    np.testing.assert_allclose(piece.point(s), helix_points(s + 20), atol=1e-8)
    assert piece.length_at(0.5) == 15


@pytest.mark.parametrize("ends", [(-1, 5), (5, 5), (9, 3), (0, 1e4), (math.nan, 3)])
def test_a_piece_outside_the_curve_is_refused(ends):
    with pytest.raises(CurveError, match="piece"):
        helix().part(*ends)


@pytest.mark.parametrize(("drop", "kept"), [("start", [50, 150]), ("end", [0, 100])])
def test_trimming_drops_the_end_that_was_asked_for(drop, kept):
    curve = trim_curve(curve_from_points(helix_points(ARC_LENGTHS)), 100, drop)
    assert curve.length == pytest.approx(100)
    np.testing.assert_allclose(curve.point(np.array([0, curve.length])), helix_points(np.array(kept)), atol=1e-3)


def test_trimming_leaves_a_short_curve_alone():
    curve = helix()
    assert trim_curve(curve, 200, "start") is curve


# Placed before the robot


@given(rigid_transforms())
def test_placed_curve_starts_at_the_origin_with_its_first_10_mm_along_z(transform):
    curve, _ = move_to_robot_frame(helix().apply_transform(transform))
    start, ten = curve.point(np.array([0.0, 10.0]))
    np.testing.assert_allclose(start, 0, atol=1e-9)
    np.testing.assert_allclose(ten / np.linalg.norm(ten), [0, 0, 1], atol=1e-9)


@given(rigid_transforms())
def test_placing_is_the_rigid_transform_that_it_reports(transform):
    curve = helix().apply_transform(transform)
    moved, to_robot = move_to_robot_frame(curve)
    rotation = to_robot[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_array_equal(to_robot[3], [0, 0, 0, 1])
    s = np.linspace(0, curve.length, 20)
    np.testing.assert_allclose(moved.point(s), curve.point(s) @ rotation.T + to_robot[:3, 3], atol=1e-9)


@given(rigid_transforms())
def test_placing_turns_by_the_smallest_rotation(transform):
    """No rotation takes the heading to z by less than the angle between them."""
    curve = helix().apply_transform(transform)
    heading = np.diff(curve.point(np.array([0.0, 10.0])), axis=0)[0]
    angle = Rotation.from_matrix(move_to_robot_frame(curve)[1][:3, :3]).magnitude()
    assert angle == pytest.approx(math.acos(np.clip(heading[2] / np.linalg.norm(heading), -1, 1)), abs=1e-7)


@pytest.mark.parametrize("direction", [(0, 0, -1), (1e-14, 0, -1), (1e-9, 0, -1), (0, 0, 1)])
def test_a_path_along_the_z_axis_is_placed_without_a_reflection(direction):
    curve, to_robot = move_to_robot_frame(curve_from_points(np.outer(np.arange(0, 60, 2.0), direction) + 7.0))
    assert np.linalg.det(to_robot[:3, :3]) == pytest.approx(1)
    np.testing.assert_allclose(curve.point(np.array([58.0]))[0], [0, 0, 58], atol=1e-6)


def test_a_path_that_returns_at_once_has_no_direction():
    r = 10 / (2 * ca.pi)
    curve = curve_from_formula(lambda u: (r * ca.cos(u), r * ca.sin(u), 0), 0.0, 2 * ca.pi)
    with pytest.raises(CurveError, match="insertion direction"):
        move_to_robot_frame(curve)


# Bad input


def edited(index, value):
    points = helix_points(ARC_LENGTHS)
    points[index] = value
    return points


@pytest.mark.parametrize(
    ("points", "message"),
    [
        (helix_points(ARC_LENGTHS[:3]), "number of points.* is 3; it must be at least 4"),
        (np.zeros((0, 3)), "number of points.* is 0; it must be at least 4"),
        (edited(7, math.nan), "point 8 .*finite"),
        (edited((4, 1), math.inf), "point 5 .*finite"),
        (edited(8, helix_points(ARC_LENGTHS)[7]), "points 8 and 9 are the same"),
        (helix_points(ARC_LENGTHS)[:, :2], r"shape \(151, 2\)"),
        (helix_points(ARC_LENGTHS).ravel(), "shape"),
        (helix_points(ARC_LENGTHS) / 1000, r"0\.15 long.*millimetres"),
    ],
    ids=["three", "none", "nan", "inf", "repeated", "flat", "one column", "metres"],
)
def test_points_that_are_no_centreline_are_refused(points, message):
    with pytest.raises(CurveError, match=message):
        curve_from_points(points)


@pytest.mark.parametrize("radius", [-1.0, 0.0, math.nan, math.inf])
def test_a_radius_that_is_not_positive_is_refused(radius):
    radii = np.full(len(ARC_LENGTHS), 5.0)
    radii[3] = radius
    with pytest.raises(CurveError, match="radii"):
        curve_from_points(helix_points(ARC_LENGTHS), radii)


@pytest.mark.parametrize("smoothing", [-0.1, math.nan, math.inf])
def test_a_smoothing_bound_below_zero_is_refused(smoothing):
    with pytest.raises(CurveError, match="smoothing"):
        curve_from_points(helix_points(ARC_LENGTHS), smoothing=smoothing)


ROWS = "\n".join(f"{x},{y},{z}" for x, y, z in helix_points(ARC_LENGTHS))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "first line is ''"),
        (b"\n \n", "first line is ''"),
        (ROWS.encode(), "expected a header"),
        (f"x_mm,y_mm\n{ROWS}".encode(), "expected a header"),
        (f"x_mm,y_mm,z_mm,z_mm\n{ROWS}".encode(), "row 2 has 3 cells, but the header has 4"),
        (f"x_mm;y_mm;z_mm\n{ROWS}".encode(), "row 2 has 1 cells, but the header has 3"),
        (b"x_mm,y_mm,z_mm\n", "number of points.* is 0; it must be at least 4"),
        (f"x_mm,y_mm,z_mm\n{ROWS}\n1,2".encode(), "row 153 has 2 cells"),
        (f"x_mm,y_mm,z_mm\n{ROWS}\n1,2,3,4".encode(), "row 153 has 4 cells"),
        (f"x_mm,y_mm,z_mm\n1,two,3\n{ROWS}".encode(), "row 2 is '1,two,3'"),
        (f"x_mm,y_mm,z_mm\n1,,3\n{ROWS}".encode(), "row 2 is '1,,3'"),
        (f"x_mm,y_mm,z_mm\n{ROWS}\nnan,0,0".encode(), "point 152 .*finite"),
        (b"x_mm,y_mm,z_mm,radius_mm\n0,0,0,1\n0,0,5,1\n0,0,9,-1\n0,0,20,1", "radii"),
        (b"x_mm,y_mm,z_mm\n0,0,0\n0,0,0.05\n0,0,0.1\n0,0,0.15", r"span 0\.15 mm .*--units m,"),
        (bytes(range(128, 256)) * 8, "is not a centreline"),
        (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "cannot be read"),
        (b"\0" * 64, "cannot be read"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_centreline_is_refused_by_name(tmp_path, content, message):
    path = tmp_path / "wrong.csv"
    path.write_bytes(content)
    with pytest.raises(CurveError, match=rf"(?s)wrong\.csv.*{message}"):
        read_csv(path)


def test_a_missing_file_or_a_folder_is_refused(tmp_path):
    for path in (tmp_path / "nowhere.csv", tmp_path):
        with pytest.raises(CurveError, match="cannot be read"):
            read_csv(path)


@given(st.one_of(st.binary(max_size=200), st.text("0123456789.,-e\n", max_size=200).map(str.encode)))
def test_no_bytes_raise_anything_but_a_curve_error(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "fuzz.csv"
    path.write_bytes(b"x_mm,y_mm,z_mm\n" + content)
    with contextlib.suppress(CurveError):
        assert np.isfinite(read_csv(path).length)


@given(st.lists(numbers(0.01, 10), min_size=4, max_size=60), seeds)
def test_any_path_of_reasonable_steps_makes_a_finite_curve(steps, seed):
    directions = np.random.default_rng(seed).normal([0, 0, 1], 1, (len(steps), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = np.cumsum(directions * np.array(steps)[:, None], axis=0)
    assume(sum(steps[1:]) > 1.001)
    curve = curve_from_points(points)
    s = np.linspace(0, curve.length, 50)
    assert curve.length >= sum(steps[1:]) - 1e-6
    assert np.isfinite(curve.point(s)).all()
    assert np.isfinite(curve.curvature(s)).all()


def test_points_millionths_of_a_millimetre_apart_raise_nothing_but_a_curve_error():
    z = np.sort(np.concatenate([np.arange(0, 40, 2.0), 4 + 1e-6 * np.arange(1, 4)]))
    with contextlib.suppress(CurveError):
        assert np.isfinite(curve_from_points(np.stack([z**2 / 100, 0 * z, z], axis=1)).length)


# Real airways


@pytest.mark.parametrize("name", ["chaste_ts002_LLL", "chaste_ts002_RLL", "chaste_ts002_RML", "hra_vhm_left_main"])
def test_real_centrelines_are_followed_through_their_points(shared_data, name):
    path = shared_data / "airways" / f"{name}.csv"
    table = np.loadtxt(path, delimiter=",", skiprows=1)
    curve = read_csv(path)
    assert gap(curve, table[:, :3]) < 0.01
    s = np.linspace(0, curve.length, 400)
    assert np.isfinite(curve.curvature(s)).all()
    assert curve.radius(s).min() >= table[:, 3].min() - 1e-9
    assert curve.radius(s).max() <= table[:, 3].max() + 1e-9


def test_a_path_of_kilometres_is_refused():
    s = np.arange(0, 150.1)
    with pytest.raises(CurveError, match="at most 100000 mm"):
        curve_from_points(1e8 * np.stack([s**2 / 100, np.sin(s), s], 1))
