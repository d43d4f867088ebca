"""What a robot cannot do in a lumen, said before solving."""

from dataclasses import replace

import numpy as np
import pytest

from ctr_nlp import Problem, Robot, curve_from_points, growing, sequence, table_i_robot
from ctr_nlp.exceptions import ProblemError
from ctr_nlp.paths.lumen_fit import Misfit, check_radii, misfits, problem_notes

Z = np.linspace(0, 140, 281)


def straight(radius=None):
    """140 mm along z."""
    points = np.column_stack([0 * Z, 0 * Z, Z])
    return curve_from_points(points, None if radius is None else np.full(len(Z), radius) + 0 * Z)


def problem(radius=None, robot=None):
    return Problem("made", robot or table_i_robot(), growing(straight(radius), 3))


def narrow(*places, wide=9.0):
    """Radii that fall to depth between start and stop, mm."""
    radius = np.full(len(Z), wide)
    for start, stop, depth in places:
        radius[(start - 1e-9 <= Z) & (stop + 1e-9 >= Z)] = depth
    return radius


def test_a_wide_lumen_needs_no_words():
    assert misfits(problem(3.0)) == []
    assert problem_notes(problem(3.0)) == []


def test_nothing_is_said_of_a_lumen_that_is_not_known():
    assert misfits(problem()) == []
    assert problem_notes(problem()) == []


def test_the_innermost_tube_must_go_everywhere():
    (found,) = misfits(problem(narrow((120, 125, 0.9))))
    assert (found.tube, found.forced) == (3, True)
    assert (found.start, found.stop) == pytest.approx((120, 125), abs=0.6)
    assert found.radius_excess == pytest.approx(2.1 / 2 - 0.9, abs=1e-6)
    assert 120 <= found.at <= 125
    (note,) = problem_notes(problem(narrow((120, 125, 0.9))))
    assert note.startswith("tube 3 (2.1 mm) does not fit even centred from 1")
    assert "by up to 0.15 mm at 12" in note
    assert note.endswith("contact there cannot be avoided")


def test_outer_tubes_may_stay_behind():
    """A place at 30 mm that is 3 mm wide: tubes 1 and 2 could be slid there and need not."""
    found = misfits(problem(narrow((30, 32, 1.5))))
    assert [(each.tube, each.forced) for each in found] == [(1, False), (2, False)]
    assert found[0].radius_excess == pytest.approx(5.7 / 2 - 1.5, abs=1e-6)
    assert found[0].start == pytest.approx(29.8, abs=0.4)
    first, second = problem_notes(problem(narrow((30, 32, 1.5))))
    assert first.startswith("tube 1 (5.7 mm) does not fit beyond 29.")
    assert "narrows to 3.00 mm (at 3" in second
    assert second.endswith("it has to stay behind")


def test_a_place_that_a_tube_does_not_reach_is_not_its_own():
    assert misfits(problem(narrow((60, 62, 2.0)))) == [
        each for each in misfits(problem(narrow((60, 62, 2.0)))) if each.tube == 2
    ]
    assert misfits(problem(narrow((110, 112, 1.8)))) == []


@pytest.mark.parametrize(
    ("limits", "forced"),
    [
        ({"beta": ((0, 50), (0, 107), (0, 150))}, False),
        ({"beta": ((35, 50), (35, 107), (35, 150))}, True),
        ({"beta": ((0, 50), (0, 107), (0, 150)), "carriage_gap": 80}, True),
    ],
)
def test_lower_limits_and_carriages_can_force_an_outer_tube(limits, forced):
    """Tube 3 at 140 mm drags tube 2 to 140 + 80 - 188 = 32 mm at least, where carriages keep 80 mm apart."""
    found = misfits(problem(narrow((30, 31, 1.8)), table_i_robot().with_limits(**limits)))
    assert {each.tube: each.forced for each in found}[2] is forced


def test_a_place_may_be_partly_forced():
    robot = table_i_robot().with_limits(beta=((30, 50), (30, 107), (30, 150)))
    ours = [each for each in misfits(problem(narrow((25, 40, 2.5)), robot)) if each.tube == 1]
    assert [each.forced for each in ours] == [True, False]
    assert ours[0].stop <= 30 < ours[1].start <= 30.2


def test_several_narrow_places_are_one_sentence():
    made = problem(narrow((20, 22, 0.9), (60, 61, 0.8), (100, 101, 0.9)))
    assert len([each for each in misfits(made) if each.tube == 3]) == 3
    (note,) = [each for each in problem_notes(made) if each.startswith("tube 3")]
    assert "in 3 places from " in note
    assert "by up to 0.25 mm at 6" in note


def test_the_lumen_counts_that_was_given_beside_the_path():
    """The path is moved off a lumen's middle: the lumen's radius at the nearest place is what a tube must fit."""
    lumen = straight(narrow((120, 125, 0.9)))
    aside = np.eye(4)
    aside[0, 3] = 0.5
    made = Problem("made", table_i_robot(), growing(straight(3.0).apply_transform(aside), 3), lumen=lumen)
    assert [each.tube for each in misfits(made)] == [3]


def test_one_tube_robots_are_told_too():
    robot = Robot(table_i_robot().tubes[2:])
    assert misfits(problem(1.0, robot)) == [Misfit(1, 0.0, pytest.approx(140), pytest.approx(0.05), 0.0, True)]


def test_a_jagged_path_asks_for_smoothing():
    random = np.random.default_rng(0)
    points = np.column_stack([0 * Z, 0 * Z, Z]) + random.normal(0, 0.2, (len(Z), 3))
    (note,) = problem_notes(Problem("made", table_i_robot(), growing(curve_from_points(points).part(0, 140), 3)))
    assert note.startswith("the path is jagged: at ")
    assert note.endswith("--smoothing MM evens it out")
    smooth = curve_from_points(points, np.full(len(Z), 6.0), smoothing=0.8)
    (note,) = problem_notes(Problem("made", table_i_robot(), growing(smooth, 3)))
    share = 100 * smooth.deviation_share
    expected = f"at most {smooth.deviation:.2f} mm and {share:.0f} % of the lumen's radius"
    assert note == f"smoothing moved the path by {expected}"


def test_a_base_that_cannot_turn_to_the_path_is_told():
    leaning = np.eye(4)
    leaning[:3, :3] = [[np.cos(0.2), 0, np.sin(0.2)], [0, 1, 0], [-np.sin(0.2), 0, np.cos(0.2)]]
    made = Problem("made", table_i_robot(), growing(straight().apply_transform(leaning), 3))
    assert problem_notes(made) == []
    assert problem_notes(replace(made, robot=made.robot.with_limits(theta=(-0.21, 0.21)))) == []
    assert problem_notes(replace(made, robot=made.robot.with_limits(theta=((0, 0), (0, 0.2))))) == []
    (note,) = problem_notes(replace(made, robot=made.robot.with_limits(theta=(-0.1, 0.1))))
    assert note == (
        "the path starts 11.5 degrees off the insertion direction; tilting the base as far as its limits allow "
        "leaves 5.7 degrees"
    )


def test_clearance_without_radii_is_refused():
    check_radii(problem(3.0))
    with pytest.raises(ProblemError, match=r"made has no lumen radii; give them in mm as the column radius_mm"):
        check_radii(problem())


# The lumen of a problem


def test_a_path_with_a_radius_is_its_own_lumen():
    path = straight(3.0)
    assert Problem("made", table_i_robot(), growing(path, 3)).lumen is path
    assert Problem("made", table_i_robot(), growing(path, 3)).retraction().lumen is path


def test_a_lumen_taken_away_stays_away():
    walled = Problem("made", table_i_robot(), growing(straight(3.0), 3))
    free = replace(walled, lumen=None)
    assert free.lumen is free.retraction().lumen is free[:2].lumen is None
    assert Problem("made", table_i_robot(), growing(straight(3.0), 3), lumen=None).lumen is None


def test_shapes_that_change_have_no_lumen_of_their_own():
    shapes = [straight(3.0).part(0, 70), straight(3.0)]
    assert Problem("made", table_i_robot(), sequence(shapes)).lumen is None


def test_a_lumen_without_a_radius_is_refused():
    with pytest.raises(ProblemError, match="lumen is a curve without a radius"):
        Problem("made", table_i_robot(), growing(straight(3.0), 3), lumen=straight())
