"""Plans as values: copies that are equal, some of their frames, one after the other, other paces of frames."""

from __future__ import annotations

import copy
import json
import pickle
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from malformed import plan

from ctr_nlp import Plan, Problem, Robot, Tube, curve_from_formula, growing, summary
from ctr_nlp.exceptions import OptionError
from ctr_nlp.plan.metrics import by_frame, e1
from ctr_nlp.plan.plan import plan_from_configurations
from ctr_nlp.plan.verdicts import NO, NOT_CHECKED, YES, Verdicts

BEFORE = Path(__file__).resolve().parents[1] / "data" / "before"
NAMES = ("alpha", "beta", "theta", "target", "shape", "clearance", "success", "stability_between")


def made(q: np.ndarray, model: str, problem: Problem) -> Plan:
    each = dict.fromkeys(("solve_time", "objective", "kkt"), np.arange(len(q), dtype=float))
    told = dict(plan().meta) | {"model": model}
    return plan_from_configurations(problem, q, told, success=np.full(len(q), True), **each)


def failing(bad: int = 2) -> Plan:
    """The plan of four frames with one, from 1, that was not solved."""
    success = np.arange(1, 5) != bad
    return replace(plan(), success=success, meta=plan().meta | {"failures": {str(bad): "why"}})


TWO = Robot((Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)))
PATH = curve_from_formula(lambda u: (0.0 * u, 0.0, u), 0.0, 80.0)


def turned(frames: int) -> Plan:
    """Two tubes turned against each other, by a whole turn in 20 frames: they snap once."""
    q = np.zeros((frames, 6))
    q[:, 0], q[:, 2:4] = np.linspace(0, 2 * np.pi, 21)[:frames], (60.0, 80.0)
    return made(q, "elastic", problem(frames))


def problem(frames: int) -> Problem:
    return Problem("turned", TWO, growing(PATH, frames))


@pytest.fixture(scope="module")
def snapping() -> Plan:
    return turned(21)


def test_copies_of_a_plan_are_equal(tmp_path):
    plan().save(tmp_path / "plan.npz")
    unknown = replace(plan(), objective=np.full(4, np.nan))
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        sent = pool.submit(copy.copy, plan()).result()
    assert sent == copy.deepcopy(plan()) == copy.copy(plan()) == plan() == Plan.load(tmp_path / "plan.npz")
    assert pickle.loads(pickle.dumps(unknown)) == unknown != plan()
    assert plan() != failing() != "plan"
    with pytest.raises(TypeError, match="unhashable"):
        hash(plan())


def test_a_stretch_has_its_frames_and_their_numbers():
    some = failing(3)[1:3]
    assert some.time.tolist() == plan().time[:2].tolist()
    assert some.dt == plan().dt
    for name in NAMES:
        np.testing.assert_array_equal(getattr(some, name), getattr(failing(3), name)[1:3])
    assert some.meta["failures"] == {"2": "why"}
    assert some.meta["problem"]["frames"] == 2
    assert some.meta["problem"]["duration"] == pytest.approx(2 * plan().dt)
    assert some.verdicts.solved.word == NO
    assert failing(3)[:2].meta["failures"] == {}
    assert plan()[:] == plan()
    assert summary(some)["failed"] == 1
    np.testing.assert_allclose(by_frame(some)["e2"], by_frame(plan())["e2"][1:3], rtol=1e-14)


def test_what_a_stretch_says_without_the_wall_is_of_its_own_frames():
    walled = replace(plan(), free=plan().q, meta=plan().meta | {"e3_free": 5.0})
    error = e1(plan())[2:]
    assert walled[2:].meta["e3_free"] == pytest.approx(summary(plan()[2:])["e3"], rel=1e-12)
    assert error.shape == (2, 101)


def test_stretches_that_are_joined_are_the_plan():
    again = plan()[:3] + plan()[3:]
    for name in (*NAMES, "time", "objective"):
        np.testing.assert_allclose(getattr(again, name), getattr(plan(), name), rtol=1e-12, atol=1e-12)
    assert again.meta["joined"]["frames"] == [3, 1]
    assert again.meta["joined"]["step"]["beta"] == pytest.approx(np.abs(plan().beta[3] - plan().beta[2]).max())
    assert again.verdicts.solved == plan().verdicts.solved
    assert again.verdicts.within_limits == plan().verdicts.within_limits


def test_failures_of_a_joined_plan_have_its_numbers():
    both = failing(2) + failing(3)
    assert both.meta["failures"] == {"2": "why", "7": "why"}
    assert both.success.tolist() == [True, False, True, True, True, True, False, True]
    assert both.verdicts.solved.word == NO


def test_a_reversed_plan_has_the_margins_and_snaps_of_the_steps_that_it_makes():
    snap = {"frame": 2, "before": 0.1, "jump": 3.0}
    margins = {"stability": np.array([0.9, 0.8, 0.7, 0.6]), "stability_between": np.array([0.5, 0.4, 0.3, 0.2])}
    back = replace(plan(), **margins, meta=dict(plan().meta) | {"snaps": [snap, snap | {"frame": 1}]}).reversed()
    assert back.stability.tolist() == [0.6, 0.7, 0.8, 0.9]
    assert back.stability_between.tolist() == [0.6, 0.2, 0.3, 0.4]  # nothing leads to the first frame
    assert [snap["frame"] for snap in back.meta["snaps"]] == [4]


def test_failures_keep_their_frames_on_the_way_back():
    back = failing(2).reversed()
    assert back.meta["failures"] == {"3": "why"}
    assert back.success.tolist() == [True, True, False, True]
    assert back.reversed().meta["failures"] == {"2": "why"}
    assert plan().resampled(frames=10)[:4].reversed().meta["interpolated"] == [2, 3]


def test_the_step_from_one_plan_to_the_next_counts():
    """The second begins where the first did: the robot would have to jump back."""
    fast = replace(plan(), time=plan().time / 5)
    assert fast.verdicts.within_limits.word == YES
    assert (fast + fast).verdicts.within_limits.word == NO
    assert "frame 5" in (fast + fast).verdicts.within_limits.why


def test_joined_plans_are_judged_by_the_stricter_options():
    kind, strict = (
        replace(plan(), meta=plan().meta | {"options": {"contact_allowed": allowed, "contact_weight": 30.0}})
        for allowed in (9.0, 0.5)
    )
    assert (kind + strict).options["contact_allowed"] == (strict + kind).options["contact_allowed"] == 0.5


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (lambda p: 3, "joined with 3"),
        (lambda p: replace(p, time=2 * p.time), "dt of two plans"),
        (lambda p: replace(p, lumen=None, clearance=None), "lumen of two plans"),
        (lambda p: replace(p, meta=p.meta | {"model": "elastic", "evaluated": "dominant"}), "model of two plans"),
        (lambda p: p.evaluate_on("elastic"), "evaluated on"),
        (lambda p: replace(p, meta=p.meta | {"robot": p.robot.with_locked_tilt().to_dict()}), "robot of two"),
    ],
)
def test_plans_that_differ_cannot_be_joined(other, why):
    with pytest.raises(OptionError, match=why):
        plan() + other(plan())


@pytest.mark.parametrize("wrong", [slice(3, 3), slice(0, 4, 2), slice(9, 12), 1, None])
def test_what_is_no_stretch_is_refused(wrong):
    with pytest.raises(OptionError, match=r"\[first:stop\] within 0 and 4"):
        plan()[wrong]


def test_more_frames_lie_on_the_lines_between_frames():
    fine = plan().resampled(frames=7)
    assert fine.dt == pytest.approx(plan().dt / 2)
    for name in ("q", "target"):
        given, found = getattr(plan(), name), getattr(fine, name)
        np.testing.assert_array_equal(found[::2], given)
        np.testing.assert_allclose(found[1::2], (given[1:] + given[:-1]) / 2, atol=1e-12)
    np.testing.assert_allclose(fine.shape[::2], plan().shape, atol=1e-12)
    assert np.linalg.norm(fine.shape[1] - (plan().shape[0] + plan().shape[1]) / 2, axis=-1).max() > 1e-3
    assert fine.success.tolist() == [True, False] * 3 + [True]
    assert np.isnan(fine.kkt).tolist() == [False, True] * 3 + [False]
    assert set(fine.meta["failures"]) == {"2", "4", "6"}
    assert fine.meta["interpolated"] == [2, 4, 6]
    assert fine.meta["resampled"] == {"frames": 4, "dt": plan().dt}
    assert fine.verdicts.solved.word == NOT_CHECKED
    assert "3 of 7 frames are interpolated" in fine.verdicts.solved.why
    assert plan().resampled(dt=plan().dt / 2) == fine


def test_frames_that_are_made_finer_and_left_out_again_are_those_of_before():
    again = plan().resampled(frames=7).resampled(frames=4)
    for name in (*NAMES, "objective"):
        np.testing.assert_allclose(getattr(again, name), getattr(plan(), name), atol=1e-12)
    assert again.verdicts.solved.word == YES
    assert plan().resampled(frames=4).success.all()


@pytest.mark.parametrize("frames", [2, 3, 5, 7, 10])
@pytest.mark.parametrize("bad", [1, 2, 3, 4])
def test_no_frame_that_failed_is_hidden_by_leaving_it_out(frames, bad):
    assert failing(bad).resampled(frames=frames).verdicts.solved.word == NO


def test_frames_of_a_finer_plan_keep_what_they_are_in_stretches_and_sums():
    fine = plan().resampled(frames=7)
    assert fine[1:5].meta["interpolated"] == [1, 3]
    assert fine[1:5].verdicts.solved.word == NOT_CHECKED
    assert fine[2:3].verdicts.solved.word == YES
    assert (fine + fine).meta["interpolated"] == [2, 4, 6, 9, 11, 13]


@pytest.mark.parametrize(
    ("asked", "why"),
    [
        ({}, "give one of them"),
        ({"frames": 3, "dt": 1.0}, "give one of them"),
        ({"frames": 1}, "whole number of at least 2"),
        ({"dt": 0.0}, "dt is 0.0 s"),
        ({"dt": 1.7}, "multiple of it"),
    ],
)
def test_paces_that_cannot_be_had_are_refused(asked, why):
    with pytest.raises(OptionError, match=why):
        plan().resampled(**asked)
    with pytest.raises(OptionError, match="one frame"):
        plan()[:1].resampled(frames=3)


def test_a_snap_stays_where_it_is_and_is_found_where_plans_meet(snapping):
    (snap,) = snapping.meta["snaps"]
    frame = snap["frame"]
    assert 2 < frame < 21
    assert snapping.verdicts.stable.word == NO
    assert snapping[frame - 2 :].meta["snaps"] == [{**snap, "frame": 2}]
    assert snapping[frame - 1 :].verdicts.stable.word == NO
    assert snapping[: frame - 1].verdicts.stable.word == YES
    again = snapping[: frame - 1] + snapping[frame - 1 :]
    assert again.meta["snaps"][0]["frame"] == frame
    assert again.verdicts.stable.word == NO
    assert snapping.resampled(frames=41).verdicts.stable.word == NO


def test_a_robot_that_would_get_elsewhere_is_not_said_to_follow(snapping):
    """Where it goes back from a snap it does not snap back at once; one that is settled there never snapped."""
    frame = snapping.meta["snaps"][0]["frame"]
    before, after = snapping[:frame], made(snapping.q[frame - 2 : frame - 1], "elastic", problem(1))
    assert np.linalg.norm(after.shape[0] - before.shape[-1], axis=-1).max() > 1
    both = before + replace(after, time=before.time[:1])
    assert not both.success[-1]
    assert both.meta["failures"] == {str(frame + 1): f"the robot would be elsewhere: it snaps in frame {frame}"}
    assert both.verdicts.solved.word == NO


def test_what_a_plan_says_of_itself():
    assert (
        repr(plan())
        == f"Plan(helix: 4 frames in 10 s, all solved, 3 tubes, dominant model, e3 {summary(plan())['e3']:.3g} mm)"
    )
    assert "3 solved" in repr(failing())
    html = failing()._repr_html_()
    assert html.count("<polyline") == 2 * 2 * 4
    assert "solved: no" in html


def test_a_plan_of_the_version_before_says_what_it_said():
    old, told = Plan.load(BEFORE / "plan.npz"), json.loads((BEFORE / "summary.json").read_text())
    found = summary(old)
    for name in (
        "e3",
        "e3_free",
        "e4",
        "e_max",
        "tip_max",
        "nearest_max",
        "roughness",
        "clearance_min",
        "max_step",
    ):
        assert found[name] == pytest.approx(told[name], rel=1e-12), name
    before, now = told["verdicts"], found["verdicts"]
    assert list(now) == list(Verdicts._fields), "judged anew, by the verdicts of this version"
    assert now["within_limits"]["number"] == pytest.approx(100 * before["within_limits"]["number"])
    assert now["within_wall"]["word"] == before["within_wall"]["word"] == "no"
    assert now["within_wall"]["number"] >= before["within_wall"]["number"], "the way between frames counts, too"
    assert now["arrives"]["number"] == pytest.approx(found["tip_last"])
    assert (now["stable"]["word"], now["holds"]["word"]) == (NOT_CHECKED, NOT_CHECKED)
    assert old[1:].verdicts.within_wall.word == NO
