"""Robots kept within a lumen: what the NLPs know of its wall, and plans that touch it no more than they must."""

import functools
import itertools
from dataclasses import replace

import casadi as ca
import frames as tracking
import numpy as np
import pytest
from frames import alone
from lumens import away_from_tube_ends, brute, straight, wandering
from rows import central

from ctr_nlp import (
    Limits,
    Plan,
    Problem,
    Robot,
    Settings,
    Tube,
    curve_from_points,
    growing,
    problem_from_file,
    solve_horizon,
    solve_per_frame,
    summary,
    table_i_robot,
)
from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS
from ctr_nlp.ocp.terms import ShapeDistance
from ctr_nlp.ocp.terms.lumen import (
    CENTRELINE_SMOOTHING_MM,
    SLACK_SQUARE_COST,
    WALL_COLUMN_COUNT,
    WALL_SAMPLES_PER_TUBE,
    WALL_SLOPE_COLUMN,
    WALL_SUBSAMPLES,
    no_wall_parameters,
)
from ctr_nlp.ocp.wall import WALL_SLACK_TOLERANCE_MM, Wall
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan import simulation

ROBOT = table_i_robot()
SHAPES = {"dominant": simulation.shapes, "elastic": tracking.elastic_shapes}
EVERY_MODEL = pytest.mark.parametrize("model", SHAPES)
BOTH = pytest.mark.parametrize("solve", [solve_horizon, solve_per_frame])
NO_WALL = Settings(contact_weight=0.0)
WALLED = Settings(contact_allowed=100.0)
"""Contact costs the same a mm however deep it is."""


SAMPLES = np.arange(WALL_SUBSAMPLES - 1, WALL_SUBSAMPLES * 3 * WALL_SAMPLES_PER_TUBE, WALL_SUBSAMPLES)
"""Sample points among all places along the robot."""
SUBSAMPLES = SAMPLES + np.array([[-1], [0], [1]])
"""Places beside them, (WALL_SUBSAMPLES, sample points)."""
SUBSAMPLES[:, WALL_SAMPLES_PER_TUBE - 1 :: WALL_SAMPLES_PER_TUBE] -= 1  # at tips, where nothing follows
LENGTH_AHEAD = WALL_SLOPE_COLUMN - 1
"""Column of how far the path continues ahead; the one before it is that behind."""


# What a frame knows of the wall


def drawn(seed):
    """Unknowns of any model (2d + 2,), tubes' ends apart."""
    rng = np.random.default_rng(seed)
    beta = np.sort(rng.uniform(5, 48, 3)) + np.arange(3)
    return np.concatenate([rng.uniform(-3, 3, 3), beta, rng.uniform(-0.2, 0.2, 2)])


def places(x, count):
    """Arc lengths (d, count) of so many places on every tube's visible part, evenly up to its end."""
    ends = np.insert(x[3:6], 0, 0.0)
    return np.array([np.linspace(a, b, count + 1)[1:] for a, b in itertools.pairwise(ends)])


def rooms(curve, model, x, count):
    """Lumen radius less distance less tube radius at all places, (d, count) mm, by brute force."""
    points = SHAPES[model](ROBOT, x[None], places(x, count).ravel()[None] / x[5])[0]
    distance, along = brute(curve, points)
    radii = np.array([tube.outer_diameter / 2 for tube in ROBOT.tubes])[:, None]
    # Programs round the distance.
    left = curve.radius(along) - np.hypot(distance, CENTRELINE_SMOOTHING_MM)
    return left.reshape(3, count) - radii


@functools.cache
def framed(model, walled=True):
    """A frame, and its objective and constraints as a function."""
    nlp = alone(ROBOT, model, walled=walled)
    return nlp, ca.Function("value", [nlp.x, nlp.p], [nlp.objective, nlp.g], {"cse": True})


class Described:
    """A frame of a robot in a lumen, described around unknowns x."""

    def __init__(self, model, seed, clearance=0.05, bend=1 / 60):
        self.x, self.model, self.curve = drawn(seed), model, wandering(seed, bend, length=40.0)
        self.nlp, self.value = framed(model)
        wall = Wall(ROBOT, Lumen.from_curve(self.curve), KINEMATIC_MODELS[model], 30.0, clearance)
        values, slacks = wall.local_parameters(self.x[None])
        self.slack, self.away = slacks[0], no_wall_parameters(ROBOT.d, WALL_SUBSAMPLES)
        self.values = {name: value[0] for name, value in values.items()}
        self.target = {
            "tubes": ROBOT.numbers,
            "target": np.outer(np.linspace(0, 30, 21), [0, 0, 1.0]),
            "shape_roots": ShapeDistance().roots,
        }

    def rows(self, x, slack=0.0, values=None):
        """Those of the clearance, (WALL_SUBSAMPLES, d WALL_SAMPLES_PER_TUBE) mm."""
        p = self.nlp.pack(self.target | (values or self.values))
        found = self.value(np.append(x, slack), p)[1].full().ravel()
        return found[-WALL_SUBSAMPLES * 3 * WALL_SAMPLES_PER_TUBE :].reshape(WALL_SUBSAMPLES, -1)

    def cost(self, slack):
        p = self.nlp.pack(self.target | self.values)
        return float(self.value(np.append(self.x, slack), p)[0])


@EVERY_MODEL
@pytest.mark.parametrize("seed", range(6))
def test_rows_are_the_room_at_and_beside_every_sample_point(model, seed):
    """A lumen of 40 mm: some robots are longer, and their tips beyond its end."""
    frame = Described(model, seed)
    room = rooms(frame.curve, model, frame.x, WALL_SUBSAMPLES * WALL_SAMPLES_PER_TUBE)
    room = room.ravel()[SUBSAMPLES]
    np.testing.assert_allclose(frame.rows(frame.x), room - 0.05, atol=1e-3)
    np.testing.assert_allclose(frame.rows(frame.x, 0.7), room - 0.05 + 0.7, atol=1e-3)


def test_places_beyond_the_lumens_end_are_among_those_looked_at():
    ahead = [Described("dominant", seed).values["wall"][:, LENGTH_AHEAD] for seed in range(6)]
    assert 0 < sum((each == 0).any() for each in ahead) < 6


@EVERY_MODEL
@pytest.mark.parametrize("seed", range(6))
def test_rows_change_with_the_configuration_as_the_room_does(model, seed):
    """Finite differences of both, the wall being that around x; where no place is just at the lumen's end.

    Places beside a sample point are taken to move as it does.
    """
    frame = Described(model, seed)
    found = central(lambda x: frame.rows(x).ravel(), frame.x, 1e-5)
    lumen = Lumen.from_curve(frame.curve)

    def points(x):
        """Points (3 d WALL_SAMPLES_PER_TUBE, 3) of all places, mm."""
        sigma = places(x, WALL_SUBSAMPLES * WALL_SAMPLES_PER_TUBE).ravel()[None] / x[5]
        return SHAPES[model](ROBOT, x[None], sigma)[0]

    around = points(frame.x)

    def room(x):
        near = lumen.project(around[SUBSAMPLES] + points(x)[SAMPLES] - around[SAMPLES])
        return (near.radius - np.hypot(near.distance, CENTRELINE_SMOOTHING_MM)).ravel()

    at = frame.values["wall"]
    lengths = at[:, LENGTH_AHEAD - 1 : LENGTH_AHEAD + 1]
    smooth = ((lengths == 0) | (lengths > 0.01)).all(axis=1)
    assert smooth.sum() > WALL_SUBSAMPLES * (3 * WALL_SAMPLES_PER_TUBE - 3)
    np.testing.assert_allclose(found[smooth], central(room, frame.x, 1e-5)[smooth], atol=1e-3)


@EVERY_MODEL
@pytest.mark.parametrize("clearance", [0.0, 0.4])
@pytest.mark.parametrize("seed", range(4))
def test_the_slack_needed_is_what_is_missing(model, clearance, seed):
    frame = Described(model, seed, clearance)
    missing = clearance - rooms(frame.curve, model, frame.x, WALL_SUBSAMPLES * WALL_SAMPLES_PER_TUBE).min()
    assert frame.slack == pytest.approx(max(missing, 0.0), abs=1e-3)
    assert frame.rows(frame.x, frame.slack).min() >= -1e-7


def test_contact_costs_its_weight_a_millimetre_and_a_little_more():
    frame = Described("dominant", 0)
    assert frame.cost(0.5) - frame.cost(0.0) == pytest.approx(30 * 0.5 + SLACK_SQUARE_COST * 0.25)


@EVERY_MODEL
def test_a_wall_that_is_away_holds_nothing_back(model):
    frame = Described(model, 0)
    assert frame.away["wall"].shape == (WALL_SUBSAMPLES * 3 * WALL_SAMPLES_PER_TUBE, WALL_COLUMN_COUNT)
    assert frame.rows(100 + frame.x, values=frame.away).min() > 500
    p = frame.nlp.pack(frame.target | frame.away)
    bare, value = framed(model, walled=False)
    free = value(frame.x, bare.pack(frame.target))[0]
    assert float(frame.value(np.append(frame.x, 0.0), p)[0]) == pytest.approx(float(free))


# Plans


def along(lumen, frames, length=None, robot=ROBOT, name="straight"):
    """A problem that follows a lumen's path up to a length, mm."""
    return Problem(name, robot, growing(lumen.part(0, length or lumen.length), frames), lumen=lumen)


def touched(plan):
    """By how much frames reach into the wall, (T,) mm."""
    return np.maximum(0.0, -plan.clearance.min(axis=1))


@pytest.fixture(scope="module")
def problem():
    """Tubes that are bent, in a straight lumen just wide enough: tube 1 has 1.15 mm around it."""
    return along(straight(4.0), 8)


@pytest.fixture(scope="module")
def horizons(problem):
    return [solve_horizon(problem, model="dominant", settings=settings) for settings in (NO_WALL, WALLED)]


@pytest.fixture(scope="module")
def marches(problem):
    return [solve_per_frame(problem, model="dominant", settings=settings) for settings in (NO_WALL, WALLED)]


@pytest.fixture(params=["horizons", "marches"])
def pair(request):
    """A plan that does not know the wall, and one that does."""
    return request.getfixturevalue(request.param)


def test_a_plan_that_knows_the_wall_keeps_clear_of_it(pair):
    free, kept = pair
    assert free.complete
    assert kept.complete
    assert touched(free).max() > 0.3
    assert kept.clearance.min() > 0
    assert summary(kept)["e3"] >= summary(free)["e3"]
    assert summary(kept)["contacts"] == []


def test_clearance_in_a_plan_is_lumen_radius_less_distance_less_tube(pair):
    """In a straight lumen along z: at no sample is another place of the path nearer."""
    for plan in pair:
        s = SIGMA_GRID * plan.beta[:, -1:]
        tube = np.where(s <= plan.beta[:, :1] + 1e-9, 2.85, np.where(s <= plan.beta[:, 1:2] + 1e-9, 1.85, 1.05))
        beyond = np.maximum(plan.shape[..., 2] - 120, 0) + np.minimum(plan.shape[..., 2], 0)
        distance = np.sqrt((plan.shape[..., :2] ** 2).sum(-1) + beyond**2)
        expected, between = 4 - distance - tube, away_from_tube_ends(plan)
        np.testing.assert_allclose(plan.clearance[between], expected[between], atol=1e-6)
        assert (plan.clearance <= expected + 1e-6).all()


@BOTH
def test_the_clearance_asked_for_is_kept(solve):
    plan = solve(along(straight(4.6), 8), model="dominant", settings=replace(WALLED, clearance=0.5))
    assert plan.complete
    assert 0.5 - WALL_SLACK_TOLERANCE_MM < plan.clearance.min() < 0.55
    assert plan.meta["options"]["clearance"] == 0.5


LONE = Robot((Tube(120, 100, 0.0, 4.0, 3.0),), Limits())


def tilted(radius, slope=0.02):
    """A straight tube of 2 mm radius in a straight lumen, and a target askew."""
    z = np.linspace(0, 55, 100)
    target = curve_from_points(np.column_stack([slope * z, 0 * z, z]))
    return Problem("tilted", LONE, growing(target, 3), lumen=straight(radius, 60.0))


@BOTH
def test_contact_that_cannot_be_avoided_is_reported_and_as_little_as_can_be(solve):
    """In the middle it is 0.4 mm deep along all of the tube: the target aside is not worth more."""
    plan = solve(tilted(1.6), model="dominant", settings=WALLED)
    assert plan.complete
    np.testing.assert_allclose(touched(plan), 0.4, atol=2e-3)
    (contact,) = summary(plan)["contacts"]
    assert (contact["first"], contact["last"], contact["tube"]) == (1, 3, 1)


@BOTH
def test_the_weight_of_contact_decides_what_the_target_is_worth(solve):
    """Tilted by t, a tube of L mm misses by (0.02 - t) s at s and is t L deep: 2 L^2 (0.02 - t) / 3 = 0.2 L."""
    cheap = replace(WALLED, contact_weight=0.2, clearance=0.0)
    plan = solve(tilted(2.0), model="dominant", settings=cheap)
    assert plan.complete
    expected = 0.02 * plan.beta[:, 0] - 1.5 * 0.2
    assert expected.min() > 0.05
    np.testing.assert_allclose(touched(plan), expected, atol=0.03)


@BOTH
def test_a_tube_in_a_lumen_narrower_than_itself_still_has_a_plan(solve):
    """Tube 1 is at the insertion point at least, where it is 0.85 mm too thick."""
    plan = solve(along(straight(2.0), 4, 60.0), model="dominant", settings=WALLED)
    assert plan.complete
    assert (touched(plan) > 0.85 - 1e-6).all()
    assert touched(plan)[0] < 0.9


def test_a_horizon_is_never_worse_than_its_start_contact_counted(problem, horizons):
    for start in (horizons[0].q, horizons[1].q, np.tile(drawn(3), (8, 1))):
        found = solve_horizon(problem, model="dominant", initial=[start], motion_weight=1e-5, settings=WALLED)
        least = min(described["start_objective"] for described in found.meta["starts"])
        assert found.objective.mean() <= least * (1 + 1e-9)


def test_the_objective_counts_contact_as_a_plan_has_it():
    """Less shape and motion, a horizon's objective is what contact costs; here the tube is in the middle."""
    plan = solve_horizon(tilted(1.6), model="dominant", settings=WALLED)
    weights = np.append(np.insert(np.full(19, 0.05), 0, 0.025), 0.025)
    shape = (((plan.shape - plan.target)[:, ::5] ** 2).sum(axis=-1) @ weights).mean()
    motion = plan.meta["options"]["motion_weight"] * (np.diff(plan.q, axis=0) * LONE.mm_per_unit) ** 2 / plan.dt**2
    missing = touched(plan) + 0.05 + CENTRELINE_SMOOTHING_MM
    contact = (30 * missing + SLACK_SQUARE_COST * missing**2).mean()
    assert plan.objective.mean() == pytest.approx(shape + motion.sum() / 3 + contact, rel=1e-3)


@pytest.mark.slow
@BOTH
def test_plans_on_the_elastic_model_keep_clear_too(solve):
    problem = along(straight(3.5), 4, 80.0)
    settings = NO_WALL, WALLED
    free, kept = (solve(problem, model="elastic", settings=each) for each in settings)
    assert free.complete
    assert kept.complete
    assert touched(free).max() > 0.05
    assert kept.clearance.min() > 0
    assert summary(kept)["e3"] >= summary(free)["e3"]


def test_ends_that_are_given_hold_with_a_wall(problem, horizons):
    plan = horizons[1]
    start, end = plan.q[0] + [0.05, 0, 0, 0, 0, 1, 0, 0], plan.q[-1].copy()
    end[2] += 0.05
    found = solve_horizon(problem, model="dominant", start=start, end=end, settings=WALLED)
    assert found.complete
    np.testing.assert_allclose(found.q[-1], end, atol=1e-12)
    assert (np.abs(found.q[0] - start) <= ROBOT.speed * problem.dt + 1e-6).all()
    assert touched(found)[:-1].max() < 0.01


def test_an_end_in_contact_is_kept_and_told(problem, horizons):
    """The configuration that is asked for has the last word."""
    end = horizons[0].q[-1]
    found = solve_horizon(problem, model="dominant", end=end, settings=WALLED)
    assert found.complete
    np.testing.assert_allclose(found.q[-1], end, atol=1e-12)
    assert touched(found)[-1] == pytest.approx(touched(horizons[0])[-1])


# What else a plan does with its lumen


def test_the_way_back_is_in_the_same_lumen(problem, horizons):
    plan = horizons[1]
    back = solve_horizon(problem.retraction(), model="dominant", initial=[plan.q[::-1]], settings=WALLED)
    np.testing.assert_array_equal(back.lumen, plan.lumen)
    assert back.complete
    assert back.clearance.min() > 0


def test_a_motion_played_backwards_keeps_its_lumen(horizons):
    plan = horizons[0]
    back = plan.reversed()
    np.testing.assert_array_equal(back.clearance, plan.clearance[::-1])
    np.testing.assert_array_equal(back.lumen, plan.lumen)


def test_on_another_model_the_clearance_is_that_of_its_shapes(horizons):
    plan = horizons[0]
    other = plan.evaluate_on("elastic")
    expected = Lumen(plan.lumen).clearance(ROBOT, plan.beta, SIGMA_GRID, other.shape)
    between = away_from_tube_ends(plan)
    np.testing.assert_allclose(other.clearance[between], expected[between])
    assert (other.clearance <= expected + 1e-9).all()
    assert np.abs(other.clearance - plan.clearance).max() > 0.1
    np.testing.assert_allclose(other.evaluate_on("dominant").clearance, plan.clearance, atol=1e-9)


def test_lumen_and_clearance_survive_the_file(horizons, tmp_path):
    horizons[0].save(tmp_path / "plan.npz")
    again = Plan.load(tmp_path / "plan.npz")
    np.testing.assert_array_equal(again.lumen, horizons[0].lumen)
    np.testing.assert_array_equal(again.clearance, horizons[0].clearance)
    assert summary(again)["contacts"] == summary(horizons[0])["contacts"]


@BOTH
def test_without_radii_there_is_no_wall_and_the_plan_is_that_without_a_weight(solve):
    path = curve_from_points(straight(4.0).point(np.linspace(0, 120, 61)))
    bare = solve(Problem("bare", ROBOT, growing(path.part(0, path.length), 4)), model="dominant")
    assert bare.clearance is None
    assert bare.lumen is None
    free = solve(along(straight(4.0), 4), model="dominant", settings=NO_WALL)
    assert free.clearance is not None
    np.testing.assert_allclose(bare.q, free.q, atol=1e-9)


def test_the_two_stage_formulation_only_tells_the_clearance(problem):
    plan = solve_per_frame(problem, "two-stage", direction="backward")
    assert plan.clearance.shape == (8, 101)


@pytest.mark.parametrize("name", ["clearance", "contact_weight"])
@pytest.mark.parametrize("value", [-0.1, np.nan, np.inf])
def test_settings_out_of_range_are_refused(name, value):
    with pytest.raises(OptionError, match=rf"{name} is {value}"):
        Settings(**{name: value})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["chaste_ts002_LLL", "chaste_ts002_RLL", "chaste_ts002_RML", "hra_vhm_left_main"])
@pytest.mark.parametrize("solve", [solve_horizon, solve_per_frame])
def test_on_the_elastic_model_the_robot_makes_what_is_planned_in_real_airways(name, solve, shared_data):
    """Also where the motion with least contact would snap on the way."""
    problem = problem_from_file(shared_data / "airways" / f"{name}.csv", frames=30, trim="end")
    without, kept = (
        solve(problem, model="elastic", settings=settings)
        for settings in (Settings(contact_weight=0.0), Settings())
    )
    assert without.complete
    assert kept.complete
    assert kept.meta["snaps"] == []
    assert summary(kept)["e3"] <= 1.1 * summary(without)["e3"]
    before, after = (summary(plan)["contact_depth"] for plan in (without, kept))
    assert after < before or before == 0
