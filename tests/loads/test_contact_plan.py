"""Plans that lean on a wall: forces are kept to their limit, the tip comes nearer, and nothing snaps."""

from __future__ import annotations

import json
import signal

import numpy as np
import pytest
from loaded_plans import TWO
from lumens import bent

from ctr_nlp import Plan, Problem, Robot, Target, Tube, solve_on_wall, summary, wall_forces
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import LoadError, OptionError
from ctr_nlp.loads.contact_plan import ContactReplay, judge_replay
from ctr_nlp.loads.contact_program import ContactSolution
from ctr_nlp.loads.contact_rods import ContactState
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.plan.plan import plan_from_configurations

FRAMES, LIMIT_N = 3, 0.05
SLIM = with_modulus(Robot((Tube(90, 70, 0.0005, 1.6, 1.2), Tube(150, 90, 0.0005, 1.0, 0.6))), 60_000)


@pytest.fixture(scope="module")
def problem() -> Problem:
    """The last part of a bend that the robot's tubes do not fit."""
    lengths = np.linspace(72.0, 85.0, FRAMES)
    return Problem("bend", SLIM, Target((bent(1.4, 85.0),) * FRAMES, tuple(lengths.tolist())))


@pytest.fixture(scope="module")
def start(problem) -> Plan:
    """Tubes that are pushed out along the bend without regard to its wall."""
    q = np.zeros((FRAMES, 6))
    q[:, :2], q[:, 2], q[:, 3] = 0.1, np.linspace(42, 55, FRAMES), np.linspace(72, 85, FRAMES)
    each = dict.fromkeys(("solve_time", "objective", "kkt"), np.zeros(FRAMES))
    meta = {"model": "elastic", "failures": {}, "options": {"motion_weight": 1e-6}, "interrupted": False}
    return plan_from_configurations(problem, q, meta, success=np.full(FRAMES, True), **each)


@pytest.fixture(scope="module")
def plan(problem, start) -> Plan:
    return solve_on_wall(problem, LIMIT_N, initial=start)


def test_the_force_at_a_place_is_kept_to_its_limit(plan, start):
    before = wall_forces(start)
    assert before.total.max() > 4 * LIMIT_N
    assert plan.wall_force.max() > 0
    assert np.fmax(plan.place_force, plan.place_force_between).max() <= LIMIT_N * 1.02
    assert plan.verdicts.within_wall.word == "yes"
    assert plan.verdicts.within_wall.unit == "N at one place"
    assert plan.verdicts.solved.word == "yes"
    assert plan.verdicts.holds.word == "NOT CHECKED"


def test_the_plan_is_what_contact_finds_along_its_motion(plan):
    found = wall_forces(plan)
    np.testing.assert_allclose(found.shape, plan.shape, atol=2e-3)
    np.testing.assert_allclose(found.total, plan.wall_force.sum(axis=1), atol=5e-3)
    assert np.isfinite(plan.stability_between).all()
    assert not plan.meta["snaps"]


def test_it_is_nearer_to_its_target_than_the_start_on_the_wall(plan, start):
    def error(shape):
        return float((np.linalg.norm(shape - plan.target, axis=2) ** 2).mean())

    assert error(plan.shape) < error(wall_forces(start).shape)


def test_ctrl_c_ends_the_search_with_what_was_found(problem, start):
    told = list[str]()

    def press(done: int, total: int, note: str) -> None:
        if not told:
            signal.raise_signal(signal.SIGINT)
        told.append(note)

    plan = solve_on_wall(problem, LIMIT_N, initial=start, progress=press)
    assert 1 < len(told) <= 4
    assert plan.meta["interrupted"]
    assert not plan.success.any()
    assert plan.verdicts.solved.word == "no"
    assert np.isfinite(plan.q).all()
    assert np.isfinite(plan.place_force).all()


def test_forces_are_saved_and_told(plan, tmp_path):
    plan.save(tmp_path / "plan.npz")
    assert Plan.load(tmp_path / "plan.npz") == plan
    told = json.loads(json.dumps(summary(plan)["wall_forces"], allow_nan=False))
    assert told["limit_N"] == LIMIT_N
    assert told["largest_total_N"] == pytest.approx(plan.wall_force.sum(axis=1).max())
    assert plan.reversed().place_force[0] == plan.place_force[-1]
    assert plan[1:].wall_force.shape[0] == FRAMES - 1


def test_evaluated_otherwise_it_is_judged_by_depth(plan):
    free = plan.evaluate_on("elastic")
    assert free.wall_force is None
    assert free.verdicts.within_wall.unit == "mm of contact"
    assert plan.check(samples=3) is plan


def test_what_cannot_be_planned_on_a_wall_is_refused(problem, capsys, tmp_path, monkeypatch):
    for limit in (0.0, float("nan"), 50.0):
        with pytest.raises(OptionError, match="contact_force"):
            solve_on_wall(problem, limit)
    with pytest.raises(OptionError, match="stiffness of the wall"):
        solve_on_wall(problem, stiffness=-1.0)
    with pytest.raises(LoadError, match="looks like a ratio"):
        solve_on_wall(Problem("ratios", TWO, problem.target))
    monkeypatch.chdir(tmp_path)
    for options, why in (
        (["--wall-stiffness", "0.1"], "--wall-stiffness needs --contact-force"),
        (["--contact-force", "0.2", "--model", "dominant"], "--contact-force needs --model elastic"),
        (
            ["--contact-force", "0.2", "--force", "0", "0", "0.1", "--youngs-modulus", "60000"],
            "does not go with a load",
        ),
        (["--contact-force", "0.2", "--robust"], "does not go with --robust"),
        (["--contact-force", "--youngs-modulus", "60000"], "has no wall to lean on"),
        (["--contact-force", "0.2", "--formulation", "joint"], "does not go with --formulation joint"),
    ):
        assert main(["plan", "arc", "--frames", "3", *options]) == 2
        assert why in " ".join(capsys.readouterr().err.split())


def test_of_several_rounds_the_motion_that_fails_least_is_taken():
    """First by how long the robot is where the plan has it, then by force and margin."""
    d, count = 2, 3
    one = ContactState(np.zeros(6), np.zeros(23), np.zeros(d), np.eye(3), np.zeros((1, 2, 3)), 1.0)
    states = (one,) * count
    solution = ContactSolution(states, np.zeros(count), np.zeros(count), "")

    def judged(place, margin, turned=count, known=count):
        angles = [np.array([1.0 * (j >= turned), 0.0]) for j in range(known)]
        reached = tuple(state._replace(angles=each) for state, each in zip(states, angles, strict=False))
        least = np.where(np.arange(count) < known, margin, np.nan)
        none = np.zeros(0)
        replay = ContactReplay(none, none, least, least, *[none] * 6, np.array(place), reached)
        return judge_replay(solution, replay, 0.1, 0.2)

    good, soft, lost, gone = (
        judged([0.1, 0.2, 0.2], 0.1),
        judged([0.1, 0.3, 0.2], 0.05),
        judged([0.1, 0.1, 9.0], 0.1, turned=2),
        judged([0.1, 0.1, np.nan], 0.1, known=2),
    )
    assert good.is_good
    assert [each.is_good for each in (soft, lost, gone)] == [False] * 3
    np.testing.assert_allclose(soft.missing_margin, 0.05)
    np.testing.assert_allclose(soft.force_ratio, [1.0, 1.5, 1.0])
    for each in (lost, gone):
        np.testing.assert_allclose(each.missing_margin, [0, 0, 0.3])
        np.testing.assert_allclose(each.force_ratio, 1.0)
        assert each.lost == 1
    assert good.rank < soft.rank < lost.rank
