"""What must be true before anything moves: every complaint names its frame, its axis and its value."""

from __future__ import annotations

from dataclasses import replace

import frames as tracking
import numpy as np
import pytest
from bench import homing_hardware, plan_of, sweep

from ctr_nlp import Robot, Tube
from ctr_nlp.exceptions import HardwareError, TrajectoryError
from ctr_nlp.hardware.arm.description import Arm
from ctr_nlp.hardware.description import simulated_hardware
from ctr_nlp.hardware.motion.trajectory import trajectory_of
from ctr_nlp.hardware.playing.checks import TRAJECTORY_SAMPLES_PER_FRAME, check_plan, check_trajectory
from ctr_nlp.hardware.playing.session import prepare_trajectory


def changed(name, frame, value, column=None):
    """The sweep with one number, or one frame of it, changed."""
    plan = sweep()
    array = getattr(plan, name).copy()
    array[frame - 1 if column is None else (frame - 1, column)] = value
    return replace(plan, **{name: array})


def complaint(plan, message, rig=None):
    rig = homing_hardware() if rig is None else rig
    with pytest.raises(TrajectoryError, match=message):
        check_plan(plan, rig.apply_limits(plan.robot))


def test_a_good_plan_passes():
    plan, rig = sweep(), homing_hardware()
    check_plan(plan, rig.apply_limits(plan.robot))
    trajectory, found = prepare_trajectory(plan, rig)
    assert found.late == pytest.approx(trajectory.duration - 1.9)
    assert np.isnan(found.margin)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("alpha", np.nan, r"frame 5: alpha is \[nan nan nan\]; it must be finite"),
        ("beta", np.inf, r"frame 5: beta is \[inf inf inf\]; it must be finite"),
        ("theta", -np.inf, r"frame 5: theta is \[-inf -inf\]; it must be finite"),
        ("time", np.nan, "frame 5: time is nan; it must be finite"),
        ("time", 0.4, "frame 5: time is 0.4 s, not after the frame before"),
        ("time", 0.1, "frame 5: time is 0.1 s, not after the frame before"),
        ("success", False, r"frame 5: the plan has no solution; all frames must be solved before it is played$"),
        ("shape", 1.0, r"frame 5: the plan's shape is .* mm from that of its configuration; .* within 0.05 mm"),
        ("shape", np.nan, "frame 5: the plan's shape is inf mm"),
    ],
)
def test_a_plan_with_a_wrong_number_is_refused(name, value, message):
    complaint(changed(name, 5, value), message)


@pytest.mark.parametrize("name", ["alpha", "beta", "theta", "time", "success", "shape"])
@pytest.mark.parametrize("cut", [lambda a: a[:-1], lambda a: a[..., None]], ids=["a frame short", "an axis more"])
def test_arrays_of_wrong_shapes_are_named(name, cut):
    plan = sweep()
    plan = replace(plan, **{name: cut(getattr(plan, name))})
    named = "[a-z]+" if name == "time" and plan.time.ndim == 1 else name
    complaint(plan, rf"{named} of the plan has shape \(.*\); it must be \((19|20),")


@pytest.mark.parametrize("frames", [0, 1])
def test_a_single_frame_is_no_motion(frames):
    whole = sweep()
    kept = {n: getattr(whole, n)[:frames] for n in ("time", "alpha", "beta", "theta", "shape", "success")}
    complaint(replace(whole, **kept), f"a plan of {frames} frames is no motion; give at least two")


def test_an_unsolved_frame_tells_its_reason_also_where_it_was_never_reached():
    plan = changed("success", 5, False)
    plan = replace(plan, alpha=changed("alpha", 5, np.nan).alpha, meta=plan.meta | {"failures": {"5": "too far"}})
    complaint(
        plan, r"frame 5: the plan has no solution; all frames must be solved before it is played \(too far\)"
    )


@pytest.mark.parametrize(
    ("name", "column", "value", "message"),
    [
        (
            "beta",
            0,
            -0.1,
            r"beta_1 of frame 20 is -0.1 mm; it must lie in \[0, 50\] mm on this hardware; the `range` .* "
            r"joint = \"beta_1\" .*Is the hardware file for the robot",
        ),
        ("beta", 2, 151.0, r"beta_3 of frame 20 is 151 mm; it must lie in \[0, 1\d0\] mm on this hardware"),
        ("beta", 1, 35.0, "beta_2 of frame 20 is 35 mm and exceeds beta_3, 30 mm on this hardware"),
        (
            "alpha",
            0,
            7.0,
            r"alpha_1 of frame 20 is 7 rad; it must lie in \[-6.28319, 6.28319\] rad on this hardware",
        ),
        (
            "theta",
            1,
            0.1,
            r"theta_y of frame 20 is 0.1 rad; .* \[0, 0\] rad on this hardware; it has no arm .* --lock",
        ),
        (
            "alpha",
            1,
            1.0,
            r"frame 20: alpha_2 changes by .*, .* times the speed limit of the plan's own robot \(2/s\)",
        ),
        ("beta", 2, 39.5, r"frame 20: beta_3 changes by 10.* from the frame before, 1\.\d* times .*\(90/s\)"),
        ("alpha", 2, 0.55, "frame 20: the plan's shape is .* mm from that of its configuration"),
        ("beta", 2, 30.3, "frame 20: the plan's shape is .* mm from that of its configuration"),
    ],
)
def test_the_last_frame_with_another_number_is_refused(name, column, value, message):
    complaint(changed(name, 20, value, column), message)


def test_a_carriage_gap_is_kept():
    """At beta (12, 20) mm carriages 1 and 2 are 202 - 90 - 8 = 104 mm apart."""
    plan = sweep()
    gapped = plan.robot.with_limits(carriage_gap=105.0)
    plan = replace(plan, meta=plan.meta | {"robot": gapped.to_dict()})
    complaint(plan, "carriages 1 and 2 of frame .* mm apart; carriage_gap is 105 mm on this hardware")


@pytest.mark.hazard("wrong robot")
def test_a_plan_for_another_number_of_tubes_is_refused_by_the_hardware():
    rig = simulated_hardware(sweep().robot)
    with pytest.raises(HardwareError, match="no axis moves alpha_3"):
        prepare_trajectory(sweep(), replace(rig, axes=tuple(a for a in rig.axes if not a.joint.endswith("3"))))


# On the path


def test_what_is_reported_is_what_finite_differences_find():
    trajectory, found = prepare_trajectory(sweep(), homing_hardware())
    time = np.linspace(0, trajectory.duration, 20001)
    rate = np.diff(trajectory.at(time)[0], axis=0) / time[1]
    change = np.diff(rate, axis=0) / time[1]
    assert found.speed == pytest.approx((abs(rate) / trajectory.robot.speed).max(), rel=0.02)
    assert found.acceleration == pytest.approx((abs(change) / trajectory.robot.acceleration).max(), rel=0.05)
    assert found.acceleration <= 1


@pytest.mark.parametrize("name", ["speed", "acceleration"])
@pytest.mark.hazard("limit exceeded")
def test_a_program_beyond_a_limit_is_refused(name):
    """The same motion under a robot that may do half as much."""
    trajectory, found = prepare_trajectory(sweep(), homing_hardware())
    limit = getattr(trajectory.robot, name)
    parts = trajectory.robot.split(limit * getattr(found, name) / 2)
    slow = {f"{n}_{name}": part.tolist() for n, part in zip(("alpha", "beta", "theta"), parts, strict=True)}
    with pytest.raises(
        TrajectoryError, match=rf"frame \d+: {name} of (alpha|beta)_\d would be 2 times the largest"
    ):
        check_trajectory(replace(trajectory, robot=trajectory.robot.with_limits(**slow)))


def test_play_beyond_the_range_names_axis_and_frame():
    """On the path down to 0 an axis with 0.4 mm of play has to go to -0.4."""
    out = np.linspace(2, 0, 12)[:, None]
    q = np.hstack([np.zeros((12, 3)), out, out + 5, out + 9, np.zeros((12, 2))])
    plan, rig = plan_of(q, 0.1), simulated_hardware(sweep().robot)
    prepare_trajectory(plan, rig)
    loose = replace(rig, axes=(replace(rig.axes[0], backlash=0.4), *rig.axes[1:]))
    with pytest.raises(
        TrajectoryError, match=r"frame \d+: axis X \(beta_1\) would go to -.* mm, backlash included; .*\[0, "
    ):
        prepare_trajectory(plan, loose)


def tilting(angle=0.3):
    t = np.linspace(0, 1, 12)[:, None]
    q = np.tile([0, 0, 0, 5, 10, 20, 0, 0.0], (12, 1))
    q[:, 6:] = t * [angle, -0.5 * angle]
    return plan_of(q, 0.1)


def test_a_tilt_needs_an_arm_that_is_fast_enough():
    plan = tilting()
    rig = simulated_hardware(plan.robot)
    prepare_trajectory(plan, rig)
    complaint(
        plan, r"theta_x of frame 2 is .*; it must lie in \[0, 0\] rad on this hardware", replace(rig, arm=None)
    )
    with pytest.raises(
        TrajectoryError,
        match=rf"the tilt, at {TRAJECTORY_SAMPLES_PER_FRAME} places a frame: speed of joint \d \(.*\)",
    ):
        prepare_trajectory(plan, replace(rig, arm=Arm(joint_speed_deg=5.0)))


# On the elastic model


LONG = Robot((Tube(90, 70, 0.02, 4.0, 3.2), Tube(150, 90, 0.02, 2.6, 1.6)))


@pytest.fixture
def _interpreted(monkeypatch):
    """A robot of two tests is not worth compiling."""
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")


def elastic_plan(turn, frames=30):
    """The outer of two tubes turned against the inner one, as the elastic model sees it; with what it found."""
    q = np.zeros((frames, 6))
    q[:, 0], q[:, 2:4] = np.linspace(0, turn, frames), (60, 80)
    plan = plan_of(q, 1.0, LONG)
    known = tracking.follow(LONG, q)
    return replace(
        plan, shape=tracking.elastic_shapes(LONG, known.x), meta=plan.meta | {"model": "elastic"}
    ), known


@pytest.mark.usefixtures("_interpreted")
def test_an_elastic_plan_that_is_stable_passes_with_its_margin():
    plan, known = elastic_plan(4.2)
    trajectory, found = prepare_trajectory(plan, simulated_hardware(LONG))
    assert 0 < found.margin < 0.9
    assert found.margin == pytest.approx(known.stability_between.min(), abs=0.05)
    assert np.isnan(check_trajectory(trajectory).margin)


@pytest.mark.usefixtures("_interpreted")
@pytest.mark.hazard("snap")
def test_an_elastic_plan_whose_way_snaps_is_refused():
    """Also where only the timed trajectory is looked at."""
    plan, known = elastic_plan(2 * np.pi - 0.1)
    rig = simulated_hardware(LONG)
    (snap,) = known.snaps
    complaint(plan, rf"frame {snap.frame}: the robot would snap on the path, tubes \(1, 2\)", rig)
    with pytest.raises(
        TrajectoryError, match=rf"frame {snap.frame}: the robot would snap on the path, tubes \(1, 2\)"
    ):
        check_trajectory(trajectory_of(plan, rig), model="elastic")
