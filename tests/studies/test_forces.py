"""The tip forces that plans bear, against loads raised in small steps, a discretised energy, beams and Euler."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import truth
from loaded_plans import made, turned
from loaded_truth import LoadedShot, Pull
from lumens import straight

from ctr_nlp import Load, Plan, Robot, Tube, forces
from ctr_nlp.exceptions import LoadError, OptionError
from ctr_nlp.loads.tip import cube_directions
from ctr_nlp.loads.tip_picture import draw_tip_forces
from ctr_nlp.models.loaded.following.follower import Follower

ROD = Robot((Tube(200, 150, 0.0, 1.5, 1.0, youngs_modulus=60_000),))
OUT = 100.0
"""mm by which the rod stands out."""
STIFFNESS = 60_000 * math.pi / 64 * (1.5**4 - 1.0)
"""Of the rod, N mm^2."""
GIVES_IN = OUT**3 / (3 * STIFFNESS)
"""mm/N, a cantilever's."""
EULER = math.pi**2 * STIFFNESS / (4 * OUT**2)
LEAST, RATIO = 5e-3, 1.01
"""The first force, N, and from one to the next, where they are raised by hand."""


@pytest.fixture(scope="module")
def rod() -> Plan:
    """A straight one in a straight lumen of radius 3 mm."""
    return made(ROD, np.array([[0.0, OUT, 0.0, 0.0]] * 2), straight(3.0))


@pytest.fixture(scope="module")
def near_a_fork(shared_data) -> Plan:
    """Of two frames, of margin 0.2."""
    return at_case(shared_data, 21)


def at_case(shared_data, number: int) -> Plan:
    case = truth.case(shared_data, number)
    return made(case.robot, np.stack([case.q, case.q])).with_modulus(60_000)


def raised_by_hand(plan: Plan, frame: int, directions: np.ndarray, most: float) -> np.ndarray:
    """The forces at which a frame's robot snaps, raised in steps of one per cent; infinity beyond most."""
    robot, q = plan.robot, plan.q[frame]
    follower = Follower(robot.structure, robot.numbers[None], Load(), Load().numbers(robot.d)[None, None])
    which, alone = follower.rest_without_load(q[None])
    assert len(which) == 1
    going, found = np.arange(len(directions)), np.full(len(directions), np.inf)
    states = alone.rows(np.zeros(len(directions), dtype=int))
    for force in np.geomspace(LEAST, most, math.ceil(math.log(most / LEAST, RATIO))):
        load = np.zeros((len(going), follower.loaded.rods.size))
        load[:, :3] = force * directions[going]
        states, done = follower.loaded.follow_branches(states, states.q, load)
        found[going[done < 1]] = force
        states, going = states.rows(done == 1), going[done == 1]
    return found


def agree(plan: Plan, number: int = 26, most: float = 3.0) -> int:
    """Assert that forces are those of loads raised by hand, to 2 %; how many snap."""
    found = forces(plan, directions=number, most=most)
    by_hand = raised_by_hand(plan, 0, found.directions, most)
    known = np.isfinite(found.snapping_forces[0]) & np.isfinite(by_hand)
    np.testing.assert_allclose(found.snapping_forces[0][known], by_hand[known], rtol=0.02)
    odd = np.isfinite(found.snapping_forces[0]) != np.isfinite(by_hand)
    assert (np.minimum(found.snapping_forces[0], by_hand)[odd] > 0.98 * most).all()
    return int(known.sum())


def test_directions_are_spread_evenly():
    for count in (6, 14, 26):
        found = cube_directions(count)
        assert len({tuple(row) for row in found.round(9).tolist()}) == count
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1)
        np.testing.assert_allclose(found.sum(axis=0), 0, atol=1e-12)
        np.testing.assert_allclose(found.T @ found, count / 3 * np.eye(3), atol=1e-12)


def test_forces_are_those_of_loads_raised_in_small_steps(near_a_fork):
    assert agree(near_a_fork, most=1.0) > 3


@pytest.mark.slow
@pytest.mark.parametrize("number", [2, 5, 8, 11, 14, 17, 20, 23, 26])
def test_forces_of_many_robots_are_those_of_loads_raised_in_small_steps(shared_data, number):
    agree(at_case(shared_data, number))


@pytest.mark.slow
def test_margins_of_an_independent_energy_end_at_the_force(near_a_fork):
    """Near a fold their squares fall linearly with the force."""
    worst, parts = forces(near_a_fork, every=2).least_snapping_force, (0.6, 0.9)
    pulls = [Pull(tuple(part * worst.force * worst.direction)) for part in parts]
    first, last = (LoadedShot(near_a_fork.robot, near_a_fork.q[0], pull).margin(8) ** 2 for pull in pulls)
    assert first > last
    end = parts[1] + last * (parts[1] - parts[0]) / (first - last)
    assert end == pytest.approx(1, abs=0.01)


def test_a_load_that_is_there_already_leaves_so_much_less(near_a_fork):
    free = forces(near_a_fork, every=2, directions=6)
    worst = int(free.snapping_forces[0].argmin())
    part = 0.4 * free.snapping_forces[0, worst]
    loaded = forces(near_a_fork.with_load(Load(force=part * free.directions[worst])), every=2, directions=6)
    assert loaded.snapping_forces[0, worst] == pytest.approx(free.snapping_forces[0, worst] - part, rel=0.02)


def test_a_straight_rod_gives_in_as_a_beam_does(rod):
    found = forces(rod, directions=6)
    np.testing.assert_allclose(found.compliance[0], np.diag([GIVES_IN, GIVES_IN, 0.0]), atol=1e-4 * GIVES_IN)
    assert found.largest_compliance[0] == pytest.approx(GIVES_IN, rel=1e-4)


def test_a_straight_rod_buckles_under_eulers_load(rod):
    """Two directions give way at once there, and the branch goes on."""
    found = forces(rod, directions=6)
    (down,) = np.flatnonzero(found.directions[:, 2] == -1)
    assert found.snapping_forces[0, down] == pytest.approx(EULER, rel=0.01)
    assert np.isinf(np.delete(found.snapping_forces[0], down)).all()
    assert found.least_snapping_force.force == found.snapping_forces[0, down]
    assert found.least_snapping_force.frame == 1


def test_a_rod_leaves_its_lumen_when_it_has_bent_so_far(rod):
    found = forces(rod, directions=6, off=0.5)
    expected = (3.0 - 0.75 + 0.5) / GIVES_IN
    across = np.flatnonzero(found.directions[:, 2] == 0)
    np.testing.assert_allclose(found.lumen_exit_forces[0, across], expected, rtol=0.02)
    assert found.least_lumen_exit_force is not None
    assert found.least_lumen_exit_force.force == pytest.approx(expected, rel=0.02)
    assert np.isinf(forces(rod, directions=6, off=200.0).lumen_exit_forces).all()


def test_compliance_is_symmetric_and_grows_with_a_load(near_a_fork):
    found = forces(near_a_fork, directions=6, every=2)
    each = found.compliance[0]
    np.testing.assert_allclose(each, each.T, atol=1e-3 * abs(each).max())
    assert np.linalg.eigvalsh((each + each.T) / 2).min() > -1e-6


def test_all_of_it_is_told(near_a_fork):
    found = forces(near_a_fork, directions=6, most=2.0)
    told = json.loads(json.dumps(found.summary(), allow_nan=False))
    assert told["frames"] == [1, 2]
    assert told["least_to_snap"]["force_N"] == found.least_snapping_force.force == found.snapping_forces.min()
    assert [row["frame"] for row in found.rows()] == [1, 2]
    assert found.rows()[0]["snaps_N"] == pytest.approx(found.snapping_forces[0].min(), abs=1e-5)
    assert found.rows()[0]["leaves_N"] == ""
    titles = [part.get_suptitle() for part in draw_tip_forces(found, "fork").subfigs]
    assert titles[1] == f"frame {found.least_snapping_force.frame}: largest force (N), by direction"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"directions": 7}, "directions is 7; it must be one of 6, 14, 26"),
        ({"every": 0}, "every is 0; it must be a whole number of at least 1"),
        ({"most": 1e9}, r"most is 1000000000.0 N; it must lie in \(0, 100\]"),
        ({"most": math.nan}, "most is nan N"),
        ({"off": -1}, "off is -1 mm; it must be a finite number >= 0"),
    ],
)
def test_what_is_asked_for_is_checked(rod, options, message):
    with pytest.raises(OptionError, match=message):
        forces(rod, **options)


def test_what_has_no_forces_is_refused():
    with pytest.raises(LoadError, match="looks like a ratio"):
        forces(turned())
    with pytest.raises(OptionError, match="plan is None; it must be a Plan"):
        forces(None)
    with pytest.raises(OptionError, match="off needs a wall, and the plan has none"):
        forces(turned().with_modulus(60_000), off=1.0)
