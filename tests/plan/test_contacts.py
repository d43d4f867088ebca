"""Contacts of hand-made plans with known answers, and how they are told: numbers, tables, lines and pictures."""

import csv
import json
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from test_metrics_plan import made

from ctr_nlp import Robot, Tube
from ctr_nlp.cli import plan_report
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.measures import Contact, contact_depths, contacts
from ctr_nlp.plan.metrics import by_frame, summary
from ctr_nlp.plan.motion_evaluation import wall_clearances
from ctr_nlp.view.figures import clearance as picture
from ctr_nlp.view.figures import save, save_all

LENGTH, BEFORE = 100.0, 30.0
TABLE = np.column_stack([np.zeros((361, 2)), np.linspace(-BEFORE, 150, 361), np.full(361, 5.0)])
"""A straight lumen that begins 30 mm before the insertion point."""


def touching(*least, at=60, **changes):
    """A plan with tubes that end at 20, 50 and 100 mm, whose frames have these clearances in one sample, mm."""
    count = len(least)
    clearance = np.full((count, 101), 3.0)
    clearance[:, at] = least
    clearance[np.isnan(least)] = np.nan
    target = np.tile(np.outer(LENGTH * SIGMA_GRID, [0, 0, 1.0]), (count, 1, 1))
    shape = np.where(np.isnan(np.array(least))[:, None, None], np.nan, target)
    q = np.tile([0.0, 0, 0, 20, 50, LENGTH, 0, 0], (count, 1))
    q[np.isnan(least)] = np.nan
    plan = made(shape, target, q, clearance=clearance, lumen=TABLE)
    described = plan.meta | {"failures": {}, "interrupted": False}
    return replace(plan, meta=described, **changes)


def runs(plan):
    return [(contact.first, contact.last, contact.frame) for contact in contacts(plan)]


@pytest.mark.parametrize(
    ("least", "expected"),
    [
        ((1, 2, 3), []),
        ((0, 0), []),
        ((-1e-6,), [(1, 1, 1)]),
        ((-1, -3, -2), [(1, 3, 2)]),
        ((-1, 1, -1, -2, 1), [(1, 1, 1), (3, 4, 4)]),
        ((1, 1, -1), [(3, 3, 3)]),
        ((-2, -2), [(1, 2, 1)]),
        ((-1, np.nan, -1), [(1, 1, 1), (3, 3, 3)]),
        ((np.nan, np.nan), []),
    ],
)
def test_contacts_are_runs_of_frames_each_with_its_worst(least, expected):
    assert runs(touching(*least)) == expected


def test_depth_is_what_is_beyond_the_wall():
    np.testing.assert_allclose(contact_depths(touching(1.5, -0.3, 0.0, np.nan)), [0, 0.3, 0, np.nan])


@pytest.mark.parametrize(("sample", "tube"), [(0, 1), (20, 1), (21, 2), (50, 2), (51, 3), (100, 3)])
def test_a_contact_knows_its_tube_and_its_place(sample, tube):
    """Where the shape is the path itself, arc lengths along both are the same, from the insertion point."""
    (contact,) = contacts(touching(-0.4, at=sample))
    assert contact[:5] == pytest.approx((1, 1, 0.4, 1, tube))
    assert (contact.arc_length, contact.path) == pytest.approx((sample, sample), abs=1e-9)


def test_the_place_along_the_path_is_the_nearest_one():
    plan = touching(-0.4)
    slower = plan.shape.copy()
    slower[0, :, 2] *= 0.8
    (contact,) = contacts(replace(plan, shape=slower))
    assert (contact.arc_length, contact.path) == pytest.approx((60, 48))


def test_where_no_wall_is_known_there_is_no_contact():
    plan = touching(-1.0)
    for unknown in (replace(plan, clearance=None, lumen=None), replace(plan, clearance=None)):
        assert contacts(unknown) == []
        assert np.isnan(contact_depths(unknown)).all()
        assert summary(unknown)["clearance_min"] is None
        assert summary(unknown)["contact_depth"] is None
        assert "clearance" not in by_frame(unknown)


def test_a_summary_has_the_least_clearance_and_all_contacts():
    found = summary(touching(2, -0.25, -0.5, 1, -0.125, np.nan))
    assert found["clearance_min"] == -0.5
    assert found["contact_depth"] == pytest.approx(0.875)
    first, second = found["contacts"]
    assert first == Contact(2, 3, 0.5, 3, 3, pytest.approx(60), pytest.approx(60))._asdict()
    assert (second["first"], second["last"], second["depth"]) == (5, 5, 0.125)
    assert json.loads(json.dumps(found, allow_nan=False))["contacts"] == found["contacts"]


def test_a_plan_without_any_frame_reached_has_no_clearance():
    found = summary(touching(np.nan, np.nan))
    assert found["clearance_min"] is None
    assert found["contacts"] == []
    json.dumps(found, allow_nan=False)


def test_errors_csv_has_the_least_clearance_of_every_frame(tmp_path):
    plan = touching(2.5, -0.25, np.nan)
    plan_report.write(plan, tmp_path)
    plan_report.draw(plan, [], tmp_path)
    with open(tmp_path / "errors.csv", newline="") as file:
        column = [row["clearance"] for row in csv.DictReader(file)]
    assert column == ["2.5", "-0.25", "nan"]
    assert (tmp_path / "clearance.png").exists()


@pytest.fixture
def printed(capsys):
    """What is printed about a plan, but where it was written."""

    def told(plan):
        plan_report.print_report(plan)
        return capsys.readouterr().out.partition("wrote ")[0]

    return told


def test_a_report_tells_every_contact(printed):
    text = printed(touching(2, -0.25, -0.5, 1, -0.125))
    assert "contact in frames 2 to 3: tube 3 by up to 0.50 mm, 60 mm along the path in frame 3\n" in text
    assert "contact in frame 5: tube 3 by up to 0.12 mm, 60 mm along the path in frame 5\n" in text
    (least,) = [line for line in text.splitlines() if "least clearance" in line]
    (count,) = [line for line in text.splitlines() if "frames in contact" in line]
    assert "-0.5" in least
    assert "3 / 0.875" in count


def test_a_report_without_contact_tells_the_least_clearance_alone(printed):
    text = printed(touching(2, 0.75))
    assert "least clearance" in text
    assert "0.75" in text
    assert "contact" not in text


def test_a_report_has_no_numbers_of_a_wall_that_is_not_known(printed):
    verdicts, _, text = printed(replace(touching(-1.0), clearance=None, lumen=None)).partition("numbers")
    assert "No wall is known" in verdicts
    assert "e3" in text
    for word in ("contact", "clearance", "wall", "lumen"):
        assert word not in text


# The picture


def labels(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def colours(figure):
    """What the map shows, (101, T) mm."""
    (mesh,) = figure.axes[0].collections
    return mesh.get_array()[:, ::2]


def test_the_picture_shows_every_clearance_where_it_is():
    plan = touching(2, -0.5, np.nan, 1)
    figure = picture(plan)
    shown = colours(figure)
    np.testing.assert_array_equal(shown.mask.all(axis=0), [False, False, True, False])
    np.testing.assert_allclose(shown.filled(np.nan).T, plan.clearance)
    (mesh,) = figure.axes[0].collections
    corners = mesh.get_coordinates()
    assert corners[-1, ::2, 1].tolist() == [LENGTH, LENGTH, 0, LENGTH]
    assert corners[0, :, 0].tolist() == [0.5, 1.5, 1.5, 2.5, 2.5, 3.5, 3.5, 4.5]


def test_contact_has_a_colour_of_its_own_darker_than_all_others():
    figure = picture(touching(2, -0.5))
    (mesh,) = figure.axes[0].collections
    grey = mesh.cmap(mesh.norm(np.array([-1e-3, 0.0, 1e-3, 1.0, 3.0])))[:, :3] @ [0.299, 0.587, 0.114]
    assert grey[0] < grey[1] - 0.25
    assert (np.diff(grey[1:]) >= 0).all()


def test_the_picture_marks_contacts_and_tubes_ends():
    figure = picture(touching(2, -0.25, -0.5, 1, -0.125))
    upper, lower = figure.axes[:2]
    (deepest,) = [line for line in upper.lines if line.get_label() == "deepest in contact"]
    np.testing.assert_allclose(deepest.get_xydata(), [[3, 60], [5, 60]])
    (least,) = [line for line in lower.lines if line.get_label() == "contact"]
    np.testing.assert_allclose(least.get_xydata(), [[2, -0.25], [3, -0.5], [5, -0.125]])
    ends = {patch.get_label(): patch.get_data().values for patch in upper.patches}
    assert {name: set(values) for name, values in ends.items()} == {
        "end of tube 1": {20.0}, "end of tube 2": {50.0}, "end of tube 3": {100.0}
    }  # fmt: skip
    assert len({patch.get_linestyle() for patch in upper.patches}) == 3


def test_a_picture_without_contact_names_none():
    assert labels(picture(touching(2, 1))) == [
        "at the frame",
        "beyond the wall",
        *(f"end of tube {i}" for i in (1, 2, 3)),
    ]


def test_failed_frames_and_those_not_reached_are_named():
    plan = touching(2, 1, np.nan)
    names = labels(picture(replace(plan, success=np.array([True, False, False]))))
    assert names[:2] == ["failed frame", "not reached"]


@pytest.mark.parametrize("least", [(2,), (1, -1), (np.nan,) * 4, (0,) * 2, (-1,) * 400, (np.nan, 1) * 3])
@pytest.mark.parametrize("scale", [1.0, 0.05])
def test_any_plan_has_a_picture(tmp_path, least, scale):
    plan = touching(*least)
    plan = replace(plan, clearance=scale * plan.clearance)
    assert imread(save(picture(plan), tmp_path / "clearance.png"))[..., :3].std() > 0.02


def test_axes_carry_units():
    axes = picture(touching(2, -1)).axes
    names = [each.get_ylabel() for each in axes] + [axes[1].get_xlabel()]
    assert names == ["along the robot (mm)", "least clearance (mm)", "clearance (mm), contact below 0", "frame"]


def test_where_no_wall_is_known_there_is_no_picture(tmp_path):
    paths = save_all(replace(touching(1, 1), clearance=None, lumen=None), tmp_path)
    assert "clearance.png" not in [path.name for path in paths]


def test_the_wide_end_of_a_tube_between_two_points_counts():
    """In a lumen that narrows, a straight tube is nearest to the wall at its end, wherever the points are."""
    robot = Robot((Tube(90, 50, 0.0, 2.4, 1.8), Tube(200, 100, 0.0, 1.6, 1.0)))
    z = np.linspace(0.0, 101.0, 203)
    lumen = Lumen(np.column_stack([0 * z, 0 * z, z, 4.0 - 0.03 * z]))
    beta = np.array([[40.0, 100.0], [40.6, 100.0], [100.0, 100.0]])
    shape = np.zeros((3, 101, 3))
    shape[..., 2] = np.linspace(0.0, 100.0, 101)
    (found,) = np.moveaxis(wall_clearances(robot, lumen, beta, shape), 1, 0)
    for frame, end in enumerate((40.0, 40.6, 100.0)):
        assert found[frame, min(int(end), 99)] == pytest.approx(4.0 - 0.03 * end - 1.2, abs=1e-6)
    assert found[1, 40] < found[0, 40]
    assert found[1, 41] == found[0, 41]
