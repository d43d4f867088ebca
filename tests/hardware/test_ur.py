"""Arms that follow, simulated and behind a fake of ur_rtde, and the URScript program, read back."""

from __future__ import annotations

import math
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from urscript import play

from ctr_nlp.exceptions import DeviceFault, HardwareError, OptionError
from ctr_nlp.hardware.arm.description import Arm
from ctr_nlp.hardware.arm.kinematics import insertion_error, inverse_kinematics, tilt_of_joints
from ctr_nlp.hardware.device_factory import arm_follower
from ctr_nlp.hardware.devices.arms import LONGEST_STEP, SimulatedArm
from ctr_nlp.hardware.devices.ur import STALE, UrArm
from ctr_nlp.hardware.exports.urscript import UR_LAST_SAMPLE_HOLD_S, write_urscript

pytest.importorskip("ur_analytic_ik")

DT = 0.02
SPEED = 0.3


class Clock:
    """Time that passes when told."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock():
    return Clock()


def sweep(clock, follower, ticks, speed=SPEED):
    """Tilts about y at a steady speed, rad/s; what was commanded and what was measured after each tick."""
    commanded, measured = [], []
    for k in range(1, ticks + 1):
        clock.now += DT
        commanded.append([0.0, speed * k * DT])
        follower.follow(np.array(commanded[-1]))
        measured.append(follower.tilt())
    return np.array(commanded), np.array(measured)


class TestSimulated:
    def test_moves_exactly_on_command(self, clock):
        arm = SimulatedArm(Arm(), clock=clock)
        arm.connect()
        commanded, measured = sweep(clock, arm, 20)
        assert measured == pytest.approx(commanded, abs=1e-9)
        assert insertion_error(Arm(), arm.joints()[None])[0] < 1e-6

    def test_stands_where_it_was_put(self, clock):
        arm = arm_follower(Arm(), (0.1, -0.2), clock)
        assert isinstance(arm, SimulatedArm)
        arm.connect()
        assert arm.tilt() == pytest.approx([0.1, -0.2], abs=1e-9)

    def test_a_lag_makes_it_late_by_that_much(self, clock):
        arm = SimulatedArm(Arm(), lag=0.1, clock=clock)
        arm.connect()
        commanded, measured = sweep(clock, arm, 30)
        assert (commanded - measured)[-1, 1] == pytest.approx(SPEED * 0.1, abs=SPEED * DT * 1.01)
        clock.now += 0.2
        assert arm.tilt() == pytest.approx(commanded[-1], abs=1e-9)

    def test_slow_joints_fall_behind_and_arrive_later(self, clock):
        arm = SimulatedArm(Arm(), speed=0.05, clock=clock)
        arm.connect()
        before = arm.joints()
        commanded, measured = sweep(clock, arm, 30)
        assert np.abs(arm.joints() - before).max() == pytest.approx(0.05 * 29 * DT, rel=1e-6)
        assert commanded[-1, 1] - measured[-1, 1] > 0.1
        clock.now += 60
        assert arm.tilt() == pytest.approx(commanded[-1], abs=1e-9)

    def test_a_step_beyond_the_speed_is_refused_and_not_made(self, clock):
        arm = SimulatedArm(Arm(joint_speed_deg=60), clock=clock)
        arm.connect()
        clock.now += DT
        with pytest.raises(
            DeviceFault, match=r"joint \d \(.*\) of the arm was to turn .* deg in 0.02 s; .* 60 deg/s"
        ):
            arm.follow(np.array([0.0, 0.2]))
        assert arm.tilt() == pytest.approx([0, 0], abs=1e-9)

    def test_the_limit_is_speed_times_time(self, clock):
        for factor, fails in ((0.99, False), (1.01, True)):
            arm = SimulatedArm(Arm(joint_speed_deg=60), clock=clock)
            arm.connect()
            rates = inverse_kinematics(Arm(), np.array([[0.0, 0.0], [0.0, 0.001]]), arm.joints())
            rate = np.abs(np.diff(rates, axis=0)).max() / 0.001
            clock.now += DT
            theta = np.array([0.0, factor * np.radians(60) * DT / rate])
            if fails:
                with pytest.raises(DeviceFault):
                    arm.follow(theta)
            else:
                arm.follow(theta)

    def test_a_long_silence_allows_no_long_step(self, clock):
        arm = SimulatedArm(Arm(joint_speed_deg=60), clock=clock)
        arm.connect()
        clock.now += 1000.0
        with pytest.raises(DeviceFault, match=rf"in {LONGEST_STEP:g} s"):
            arm.follow(np.array([0.0, 0.3]))

    def test_hold_stands_still_and_following_goes_on(self, clock):
        arm = SimulatedArm(Arm(), lag=0.1, clock=clock)
        arm.connect()
        sweep(clock, arm, 20)
        arm.hold()
        held = arm.tilt()
        clock.now += 1.0
        assert arm.tilt() == pytest.approx(held, abs=1e-12)
        arm.follow(held + np.array([0.0, 0.005]))
        clock.now += 0.2
        assert arm.tilt() == pytest.approx(held + np.array([0.0, 0.005]), abs=1e-9)

    def test_after_stop_it_does_not_follow(self, clock):
        arm = SimulatedArm(Arm(), lag=0.1, clock=clock)
        with pytest.raises(DeviceFault, match="not connected"):
            arm.follow(np.zeros(2))
        arm.connect()
        sweep(clock, arm, 10)
        arm.stop()
        at = arm.tilt()
        clock.now += 1.0
        with pytest.raises(DeviceFault, match="stopped"):
            arm.follow(at)
        assert arm.tilt() == pytest.approx(at, abs=1e-12)
        arm.close()

    def test_a_tilt_out_of_reach_is_a_fault(self, clock):
        arm = SimulatedArm(Arm(joint_speed_deg=1e6), clock=clock)
        arm.connect()
        clock.now += DT
        with pytest.raises(DeviceFault, match=r"cannot follow: ur3e at frame 2 of 2.*ends"):
            arm.follow(np.array([0.0, 2.2]))


class Robot:
    """What the two interfaces of ur_rtde say and take, and what they were told."""

    def __init__(self, clock, arm: Arm) -> None:
        self.clock = clock
        self.q = inverse_kinematics(arm, np.zeros((1, 2)))[0]
        self.sent: list[tuple] = []
        self.connected = self.alive = self.accepts = True
        self.protective = self.emergency = False
        self.mode = 7
        self.refuses_receive = self.refuses_control = ""
        self.raises = ""

    def receive(self, host):
        if self.refuses_receive:
            raise RuntimeError(self.refuses_receive)
        self.host = host
        stamp = self.clock()
        return SimpleNamespace(
            isConnected=lambda: self.connected,
            getTimestamp=lambda: self.clock() if self.alive else stamp,
            isProtectiveStopped=lambda: self.protective,
            isEmergencyStopped=lambda: self.emergency,
            getRobotMode=lambda: self.mode,
            getActualQ=lambda: self.q.tolist(),
            disconnect=lambda: self.sent.append(("receive off",)),
        )

    def control(self, host):
        if self.refuses_control:
            raise RuntimeError(self.refuses_control)

        def servo(q, speed, acceleration, period, ahead, gain):
            self.told(("servoJ", np.array(q), period, ahead, gain))
            if self.accepts:
                self.q = np.array(q)
            return self.accepts

        return SimpleNamespace(
            servoJ=servo,
            servoStop=lambda: self.told(("servoStop",)),
            stopScript=lambda: self.told(("stopScript",)),
            disconnect=lambda: self.sent.append(("control off",)),
        )

    def told(self, what):
        if self.raises:
            raise RuntimeError(self.raises)
        self.sent.append(what)
        return True

    @property
    def names(self):
        return [what[0] for what in self.sent]


@pytest.fixture
def robot(monkeypatch, clock):
    robot = Robot(clock, Arm())
    monkeypatch.setitem(sys.modules, "rtde_receive", SimpleNamespace(RTDEReceiveInterface=robot.receive))
    monkeypatch.setitem(sys.modules, "rtde_control", SimpleNamespace(RTDEControlInterface=robot.control))
    return robot


@pytest.fixture
def follower(robot, clock):
    return arm_follower(Arm(device="ur", host="10.0.0.2"), clock=clock)


class TestUr:
    def test_connecting_moves_nothing(self, robot, follower):
        assert isinstance(follower, UrArm)
        follower.connect()
        assert robot.host == "10.0.0.2"
        assert robot.sent == []
        assert follower.tilt() == pytest.approx([0, 0], abs=1e-9)

    def test_the_ways_of_servoj_are_those_of_ur_rtde(self):
        """The real class has the methods that the fake stands for."""
        control = pytest.importorskip("rtde_control").RTDEControlInterface
        receive = pytest.importorskip("rtde_receive").RTDEReceiveInterface
        fake = Robot(Clock(), Arm())
        assert all(hasattr(control, name) for name in vars(fake.control("")))
        assert all(hasattr(receive, name) for name in vars(fake.receive("")))

    def test_joints_that_are_sent_tilt_the_robot(self, robot, follower, clock):
        follower.connect()
        commanded, measured = sweep(clock, follower, 10)
        assert robot.names == ["servoJ"] * 10
        assert tilt_of_joints(Arm(), np.array([what[1] for what in robot.sent])) == pytest.approx(
            commanded, abs=1e-9
        )
        assert measured == pytest.approx(commanded, abs=1e-9)
        assert all(0.03 <= what[3] <= 0.2 and 100 <= what[4] <= 2000 for what in robot.sent)

    def test_the_branch_is_that_of_the_real_arm(self, robot, follower, clock):
        """Whatever joint solution planning would choose, the arm is not sent to another one."""
        pose = np.array(inverse_kinematics(Arm(), np.zeros((1, 2)))[0])
        other = next(
            q
            for turn in np.ndindex(2, 2, 2)
            for q in [inverse_kinematics(Arm(), np.zeros((1, 2)), pose * np.where(np.repeat(turn, 2), -1, 1))[0]]
            if np.abs(q - pose).max() > 0.5
        )
        robot.q = other
        follower.connect()
        sweep(clock, follower, 5)
        assert np.abs(robot.q - other).max() < 0.2

    def test_connection_refused(self, robot, follower):
        robot.refuses_receive = "Could not connect to: 10.0.0.2 at 30004, verify the IP"
        with pytest.raises(DeviceFault, match=r"the arm at 10.0.0.2 cannot be reached: Could not connect"):
            follower.connect()
        assert robot.sent == []

    def test_not_in_remote_control(self, robot, follower, clock):
        robot.refuses_control = "ur_rtde: Please enable remote control on the robot!"
        with pytest.raises(
            DeviceFault, match=r"does not take commands: .*Switch it to remote control at the pendant"
        ):
            follower.connect()
        assert robot.names == ["receive off"]
        with pytest.raises(DeviceFault, match="not connected"):
            follower.follow(np.zeros(2))

    def test_the_real_library_says_that_nothing_listens(self, clock):
        pytest.importorskip("rtde_receive")
        with pytest.raises(DeviceFault, match=r"127\.0\.0\.1 cannot be reached"):
            UrArm(Arm(device="ur"), clock=clock).connect()

    @pytest.mark.parametrize(
        ("what", "value", "message"),
        [
            ("protective", True, r"in a protective stop; release it"),
            ("emergency", True, r"in an emergency stop"),
            ("mode", 5, r"robot mode 5; it must be 7"),
            ("connected", False, r"connection to the arm at 10.0.0.2 is lost"),
        ],
    )
    def test_an_unfit_arm_is_named_at_the_start_and_in_mid_motion(
        self, robot, follower, clock, what, value, message
    ):
        fit = getattr(robot, what)
        setattr(robot, what, value)
        with pytest.raises(DeviceFault, match=message):
            follower.connect()
        assert robot.names == ["receive off"]
        setattr(robot, what, fit)
        follower.connect()
        sweep(clock, follower, 3)
        setattr(robot, what, value)
        count = len(robot.sent)
        clock.now += DT
        with pytest.raises(DeviceFault, match=message):
            follower.follow(np.array([0.0, 4 * SPEED * DT]))
        with pytest.raises(DeviceFault, match=message):
            follower.tilt()
        assert len(robot.sent) == count

    def test_a_controller_whose_time_stands_still_is_lost(self, robot, follower, clock):
        follower.connect()
        sweep(clock, follower, 3)
        robot.alive = False
        follower.tilt()
        clock.now += STALE * 1.1
        with pytest.raises(DeviceFault, match="is lost"):
            follower.tilt()

    def test_a_refused_position_is_a_fault(self, robot, follower, clock):
        follower.connect()
        robot.accepts = False
        clock.now += DT
        with pytest.raises(DeviceFault, match=r"refused a position: its control program is not running"):
            follower.follow(np.zeros(2))

    def test_what_ur_rtde_raises_in_mid_motion_is_a_fault(self, robot, follower, clock):
        follower.connect()
        robot.raises = "RTDE control script is not running!"
        clock.now += DT
        with pytest.raises(DeviceFault, match=r"does not take commands: RTDE control script is not running!"):
            follower.follow(np.zeros(2))

    def test_too_large_a_step_is_not_sent(self, robot, follower, clock):
        follower.connect()
        clock.now += DT
        with pytest.raises(DeviceFault, match="largest speed is 180"):
            follower.follow(np.array([0.3, 0.0]))
        assert robot.sent == []

    def test_an_arm_that_does_not_hold_the_insertion_point_is_refused(self, robot, follower):
        robot.q = robot.q + 0.05 * np.eye(6)[0]
        with pytest.raises(
            DeviceFault, match=r"holds the robot 20 mm from the insertion point.*move it to within"
        ):
            follower.connect()
        assert robot.names == ["receive off"]

    def test_an_arm_out_of_its_range_is_refused(self, robot, follower):
        robot.q = np.array([0.3, -1.0, 0.0, 0.4, 1.0, 0.2])
        with pytest.raises(DeviceFault):
            follower.connect()

    def test_hold_goes_on_from_where_the_arm_is(self, robot, follower, clock):
        follower.connect()
        sweep(clock, follower, 5)
        behind = inverse_kinematics(
            Arm(), np.array([[0.0, 0.0], [0.0, 3 * SPEED * DT]]), inverse_kinematics(Arm(), np.zeros((1, 2)))[0]
        )[1]
        robot.q = behind
        follower.hold()
        assert robot.names[-1] == "servoStop"
        clock.now += DT
        follower.follow(np.array([0.0, 4 * SPEED * DT]))
        assert tilt_of_joints(Arm(), robot.q[None])[0] == pytest.approx([0.0, 4 * SPEED * DT], abs=1e-9)

    def test_after_stop_nothing_is_sent(self, robot, follower, clock):
        follower.connect()
        sweep(clock, follower, 3)
        follower.stop()
        assert robot.names[3:] == ["servoStop", "stopScript", "control off"]
        count = len(robot.sent)
        clock.now += DT
        with pytest.raises(DeviceFault, match="stopped"):
            follower.follow(np.zeros(2))
        follower.hold()
        follower.stop()
        assert len(robot.sent) == count
        assert follower.tilt().shape == (2,)
        follower.close()
        assert robot.names[count:] == ["receive off"]

    def test_a_stop_that_cannot_be_told_says_so(self, robot, follower, clock):
        follower.connect()
        robot.raises = "RTDE: connection lost"
        with pytest.raises(DeviceFault, match=r"did not take the order to stop; use the emergency stop"):
            follower.stop()
        robot.raises = ""
        with pytest.raises(DeviceFault, match="stopped"):
            follower.follow(np.zeros(2))
        assert "servoJ" not in robot.names

    def test_close_raises_nothing(self, robot, follower):
        follower.close()
        follower.connect()
        robot.raises = "gone"
        follower.close()
        follower.close()
        assert "receive off" in robot.names

    def test_a_missing_library_is_named(self, monkeypatch, clock):
        monkeypatch.setitem(sys.modules, "rtde_receive", None)
        with pytest.raises(OptionError, match=r'rtde_receive is not installed; .*-m pip install "ctr_nlp\[ur\]"'):
            UrArm(Arm(device="ur"), clock=clock).connect()


class TestUrScript:
    TIME = 0.008 * np.arange(40)
    JOINTS = inverse_kinematics(Arm(), np.linspace((0, 0), (0.05, -0.1), 40))

    def test_plays_the_samples_at_their_time(self):
        found = play(write_urscript(self.TIME + 3.0, self.JOINTS))
        assert found.movej == [pytest.approx(self.JOINTS[0], abs=1e-7)]
        samples = found.samples[:40]
        assert samples == pytest.approx(self.JOINTS, abs=3e-6)
        assert set(found.periods) == {0.008}
        assert insertion_error(Arm(), samples).max() < 0.01

    def test_moves_slowly_asks_plays_settles_and_stops_in_this_order(self):
        program = write_urscript(self.TIME, self.JOINTS)
        assert program.isascii()
        body = program.splitlines()
        assert body[0] == "def ctr_nlp_arm():"
        assert body[-1] == "end"
        found = play(program)
        held = math.ceil(UR_LAST_SAMPLE_HOLD_S / 0.008)
        assert found.calls == ["movej", "popup", *["servoj"] * (40 + held), "stopj"]
        assert re.search(r"^  movej\(.*, v=0\.1\)$", program, re.M)
        assert re.search(r"^  popup\(.*blocking=True\)$", program, re.M)

    def test_the_last_sample_is_kept_until_the_arm_is_there(self):
        found = play(write_urscript(self.TIME, self.JOINTS))
        kept = found.samples[40:]
        assert len(kept) * 0.008 >= UR_LAST_SAMPLE_HOLD_S
        assert kept == pytest.approx(np.tile(self.JOINTS[-1], (len(kept), 1)), abs=1e-7)

    def test_other_periods(self):
        program = write_urscript(0.002 * np.arange(40), self.JOINTS, period=0.002, lookahead_time=0.05, gain=500)
        assert set(play(program).periods) == {0.002}
        assert "lookahead_time=0.05, gain=500)" in program

    @pytest.mark.parametrize("seed", range(6))
    def test_a_minute_of_any_motion_has_few_targets(self, seed):
        """Smooth motions with stops: within the tolerance at every sample, in a tenth of the lines."""
        rng = np.random.default_rng(seed)
        time = 0.008 * np.arange(7501)
        knots = np.sort(rng.uniform(0, 60, 12))
        parts = [np.clip((time - at) / rng.uniform(2, 6), 0, 1) for at in knots]
        steps = np.array([part**3 * (10 - 15 * part + 6 * part**2) for part in parts])
        joints = rng.uniform(-0.3, 0.3, (6, 12)) @ steps
        program = write_urscript(time, joints.T)
        assert len(program.splitlines()) < 1000
        found = play(program)
        assert len(found.servoj) == 7501 + math.ceil(UR_LAST_SAMPLE_HOLD_S / 0.008)
        assert found.seconds == pytest.approx(60 + 0.008 + UR_LAST_SAMPLE_HOLD_S, abs=0.009)
        assert found.samples[:7501] == pytest.approx(joints.T, abs=1e-5)
        assert max(len(row) for row in program.splitlines()) < 500

    @pytest.mark.parametrize("count", [1, 2, 3, 5])
    def test_short_motions(self, count):
        found = play(write_urscript(self.TIME[:count], self.JOINTS[:count]))
        assert found.samples[:count] == pytest.approx(self.JOINTS[:count], abs=3e-6)

    def test_more_targets_than_controllers_take_are_refused(self):
        time = 0.008 * np.arange(20_000)
        joints = 0.2 * np.sin(40 * time[:, None] + np.arange(6))
        with pytest.raises(HardwareError, match=r"would have more than 1000 targets for 160.0 s"):
            write_urscript(time, joints)
        assert write_urscript(time[:1000], joints[:1000]).count("ctr_nlp_spline([") <= 1000

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"period": 0.003}, r"period is 0.003 s; it must be a multiple of 0.002"),
            ({"period": 0.0}, r"period is 0.0; it must lie in \[0.002, 0.1\]"),
            ({"period": float("nan")}, r"period is nan"),
            ({"lookahead_time": 0.3}, r"lookahead_time is 0.3"),
            ({"gain": 50}, r"gain is 50"),
            ({"gain": float("nan")}, r"gain is nan"),
            ({"approach_speed": 2}, r"approach_speed is 2"),
            ({"name": "a b"}, r"name is 'a b'"),
        ],
    )
    def test_bad_options_are_named(self, options, message):
        with pytest.raises(OptionError, match=message):
            write_urscript(self.TIME, self.JOINTS, **options)

    def test_bad_samples_are_named(self):
        time = self.TIME.copy()
        time[4] = time[3]
        with pytest.raises(HardwareError, match=r"sample 5 of 40 comes 0 s after"):
            write_urscript(time, self.JOINTS)
        broken = self.JOINTS.copy()
        broken[7, 2] = np.nan
        with pytest.raises(HardwareError, match="sample 8 of 40 is not finite"):
            write_urscript(self.TIME, broken)
        broken[7, 2] = 6.4
        with pytest.raises(HardwareError, match="sample 8 of 40 has a joint beyond 360 deg"):
            write_urscript(self.TIME, broken)
        with pytest.raises(HardwareError, match=r"give \(N,\) and \(N, 6\)"):
            write_urscript(self.TIME[:3], self.JOINTS)
