"""The ROS 2 device in real time on loopback: a fake joint_trajectory_controller, its faults, the bytes sent."""

from __future__ import annotations

import itertools
import os
import re
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ctr_nlp import Plan, Problem, Tolerances, curve_from_formula, growing, table_i_robot
from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.clock import RealClock
from ctr_nlp.hardware.description import Connection, simulated_hardware
from ctr_nlp.hardware.devices.ros2.device import Ros2
from ctr_nlp.hardware.devices.ros2.joints import MAX_JOINT_STATE_SILENCE_S
from ctr_nlp.hardware.devices.ros2.messages import (
    LOOPBACK,
    Points,
    configuration,
    parse_controller_url,
    participant,
    trajectory_message,
    types,
)
from ctr_nlp.hardware.devices.ros2.track import ControllerTrack
from ctr_nlp.hardware.guiding.loop import ClosedLoop
from ctr_nlp.hardware.guiding.replay import replay_session
from ctr_nlp.hardware.journal import Journal, read_journal
from ctr_nlp.hardware.motion.trajectory import trajectory_of
from ctr_nlp.hardware.playing.player import Player
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState
from ctr_nlp.hardware.playing.session import play_plan, resume
from ctr_nlp.hardware.sensing.simulated import SimulatedRobot
from ctr_nlp.identify.closed_loop.sensors import Sensors
from ctr_nlp.identify.closed_loop.sensors.points import TipPositionSensor
from ctr_nlp.identify.closed_loop.tracker import Tracker
from ctr_nlp.plan.plan import plan_from_configurations

pytestmark = pytest.mark.real_time

pytest.importorskip("cyclonedds", reason='needs cyclonedds: pip install -e ".[ros2]"')
pytest.importorskip("toppra", reason='needs toppra: pip install -e ".[hardware]"')

FRAMES = 10
DOMAIN = 20 + os.getpid() % 80
"""Of this process, lest tests that run beside these hear them."""

names = (f"ctr_{k}" for k in itertools.count())


@pytest.fixture(scope="module")
def plan() -> Plan:
    """Ten frames in 1.2 s: tubes that slide at up to 42 mm/s and turn there and back."""
    robot, t = table_i_robot().with_locked_tilt(), np.linspace(0, 1, FRAMES)
    turn = 0.3 * np.sin(4 * t)
    columns = [turn, -0.5 * turn, 0.2 + turn, 5 + 5 * t, 15 + 20 * t, 30 + 45 * t, 0 * t, 0 * t]
    path = curve_from_formula(lambda u: (0.001 * u**2, 0.0, u), 0.0, 80.0)
    problem = Problem("short", robot, growing(path, FRAMES), duration=1.2)
    zero, meta = np.zeros(FRAMES), {"model": "dominant", "failures": {}, "options": {}, "interrupted": False}
    facts = {"solve_time": zero, "objective": zero, "kkt": zero, "success": zero == 0}
    return plan_from_configurations(problem, np.stack(columns, axis=1), meta, **facts)


def rig(plan, url):
    """A bench whose second slide counts the other way from elsewhere, and whose first turn counts in rad."""
    made = simulated_hardware(plan.robot)
    axes = list(made.axes)
    axes[1] = replace(axes[1], sign=-1, zero=150.0, range=(0.0, 150.0))
    axes[3] = replace(axes[3], unit="rad", range=(-20.0, 20.0), speed=10.0, acceleration=35.0, tolerance=0.01)
    return replace(made, axes=tuple(axes), connection=Connection("ros2", url), arm=None)


def first(plan):
    """Where joints of the first frame are, by name, in rad and m."""
    return dict(zip(plan.robot.axes[:6], plan.q[0, :6] * ([1.0] * 3 + [1e-3] * 3), strict=True))


class Controller(threading.Thread):
    """What ros2_controllers' joint_trajectory_controller and joint_state_broadcaster do, at 100 Hz.

    A valid trajectory replaces what is played, from where that is; cubic between points. joints: start by name.
    """

    def __init__(self, url: str, joints: dict[str, float], rate: float = 100.0) -> None:
        super().__init__(daemon=True)
        from cyclonedds.core import Policy, Qos
        from cyclonedds.pub import DataWriter
        from cyclonedds.sub import DataReader
        from cyclonedds.topic import Topic

        self.names, self.rate = list(reversed(joints)), rate
        self.position = np.array([joints[name] for name in self.names])
        self.velocity = np.zeros(len(joints))
        self.silent = self.frozen = self.deaf = self.missing = self.short = self.stuck = self.gone = False
        self.delay, self.nan, self.refused = 0.0, "", []
        self.track: list[tuple[float, np.ndarray]] = []
        self.arrivals: list[tuple[float, object]] = []
        self._plays, self._stop_wish = None, threading.Event()
        address = parse_controller_url(url)
        self._own, self._domain = participant(address)
        quality = Qos(
            Policy.Reliability.Reliable(10**8),
            Policy.History.KeepLast(10),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        commands = Topic(self._own, f"rt/{address.controller}/joint_trajectory", types().JointTrajectory)
        states = Topic(self._own, "rt/joint_states", types().JointState)
        self._reader = DataReader(self._own, commands, quality)
        self._writer = DataWriter(self._own, states, quality)

    def run(self):
        due = time.monotonic()
        while not self._stop_wish.is_set():
            now = time.monotonic()
            self._move(now)
            if self.gone:
                self._reader = None
            for message in self._reader.take(10) if self._reader else ():
                if isinstance(message, types().JointTrajectory):
                    self._take(now, message)
            self._move(now)
            self.track.append((now, self.position.copy()))
            if not self.silent:
                self._writer.write(self._state(now))
            due += 1 / self.rate
            time.sleep(max(0.0, due - time.monotonic()))

    def _take(self, now, message):
        """Refuse what the real one refuses, and sort to the own order of joints."""
        times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points])
        position, velocity = (
            np.array([getattr(p, k) for p in message.points]) for k in ("positions", "velocities")
        )
        wrong = sorted(message.joint_names) != sorted(self.names) or not len(times)
        if wrong or (np.diff(times) <= 0).any() or position.shape != velocity.shape or velocity[-1].any():
            self.refused.append(message)
            return
        self.arrivals.append((now, message))
        if not self.deaf:
            order = [message.joint_names.index(name) for name in self.names]
            start = (np.zeros(1), self.position[None], self.velocity[None])
            ahead = (times, position[:, order], velocity[:, order])
            self._plays = now, *(np.concatenate(pair) for pair in zip(start, ahead, strict=True))

    def _move(self, now):
        if self._plays is None:
            return
        began, times, position, velocity = self._plays
        passed = min(now - began, times[-1])
        k = min(int(np.searchsorted(times, passed, "right")) - 1, len(times) - 2)
        h, p, v = times[k + 1] - times[k], position[k : k + 2], velocity[k : k + 2]
        x, chord = passed - times[k], (p[1] - p[0]) / h
        second, third = (3 * chord - 2 * v[0] - v[1]) / h, (v[0] + v[1] - 2 * chord) / h**2
        new = p[0] + v[0] * x + second * x**2 + third * x**3
        stays = np.arange(len(new)) == (self.names.index("beta_3") if self.stuck else -1)
        self.position = np.where(stays, self.position, new)
        self.velocity = v[0] + 2 * second * x + 3 * third * x**2

    def _state(self, now):
        known, shown = types(), list(self.names)
        position = np.where([name == self.nan for name in shown], np.nan, self.position).tolist()
        if self.missing:
            shown, position = shown[1:], position[1:]
        stamp = 1e9 + (0.0 if self.frozen else now - self.delay)
        header = known.Header(known.Time(int(stamp), int(stamp % 1 * 1e9)), "")
        shown, position = ["other", *shown], [1.0, *position]
        return known.JointState(header, shown, position[: -1 if self.short else None], [], [])

    def close(self):
        self._stop_wish.set()
        self.join()

    @property
    def steps(self):
        """Times (N,) and speeds (N, m) from cycle to cycle."""
        at, position = (np.array(part) for part in zip(*self.track, strict=True))
        return at[1:], np.diff(position, axis=0) / np.diff(at)[:, None]

    def rest_after(self, moment):
        """s from a moment until the last motion that follows it within 0.55 s."""
        at, speed = self.steps
        moved = at[(abs(speed) > 1e-6).any(axis=1) & (at > moment) & (at < moment + 0.55)]
        return float(moved.max() - moment) if len(moved) else 0.0


@pytest.fixture
def stage(plan, tmp_path):
    """Controller, player and hardware, ready to begin; closed afterwards."""
    url = f"{next(names)}?domain={DOMAIN}"
    hardware = rig(plan, url)
    controller = Controller(url, first(plan))
    controller.start()
    journal = Journal(tmp_path / "journal.jsonl", RealClock())
    player = Player(Ros2(hardware, journal, RealClock()), None, journal)
    yield controller, player, hardware
    player.device.close()
    controller.close()
    journal.close()


def at_end(plan, hardware, controller):
    """How far the controller's joints are from the last frame, in parts of the axes' tolerances."""
    there = np.array(
        [dict(zip(controller.names, controller.position, strict=True))[a.joint] for a in hardware.axes]
    )
    scale = np.array([1e3 if axis.unit == "mm" else 1.0 for axis in hardware.axes])
    joints = plan.q[-1, [plan.robot.axes.index(axis.joint) for axis in hardware.axes]]
    return abs((there * scale - joints) * [a.scale for a in hardware.axes] / hardware.tolerance).max()


def once(condition, *wishes):
    """A callback that calls wishes, one after the other, each when its turn has come."""
    left = list(wishes)

    def seen(trajectory, progress):
        if left and condition(progress, len(wishes) - len(left)):
            left.pop(0)()

    return seen


def test_a_plan_is_played_to_its_last_frame(stage, plan):
    controller, player, hardware = stage
    result = play_plan(player, plan, hardware)
    assert result.outcome is PlaybackOutcome.SUCCESS, result.message
    assert at_end(plan, hardware, controller) < 0.01
    assert not controller.refused
    assert len(controller.arrivals) == 1
    records = read_journal(player.journal.path)
    assert [r["frame"] for r in records if r["kind"] == "frame"][-1] == FRAMES
    sent = [r for r in records if r["kind"] == "sent"]
    assert len(sent) == 1
    assert sent[0]["joints"] == [axis.joint for axis in hardware.axes]
    assert sent[0]["position"][-1] == list(controller.arrivals[0][1].points[-1].positions)
    received = [r for r in records if r["kind"] == "received"]
    assert len(received) == pytest.approx(len(controller.track), abs=0.2 * len(controller.track) + 30)
    assert received[-1]["position"][1:] == pytest.approx(controller.position, abs=1e-8)


def test_a_plan_is_corrected_while_it_is_played(stage, plan):
    """Every correction replaces what the controller plays, from where it is then and without a jump."""
    controller, player, hardware = stage
    sensors, moments, path = Sensors(TipPositionSensor(0.5)), [], []
    off = replace(plan.robot, tolerances=Tolerances(0.1, 0.1, motor_zero=0.1))
    led = replace(plan, meta={**plan.meta, "robot": off.to_dict()})
    loop = ClosedLoop(Tracker(led, sensors), SimulatedRobot(led, sensors, 5), lambda note: None)

    def wish(name):
        return lambda: (moments.append(time.monotonic()), getattr(player, name)())

    def due(progress, k):
        if k:
            return player.state is PlayerState.HOLD and time.monotonic() > moments[0] + 0.6
        return progress.time > 0.5

    def seen(trajectory, progress):
        path.append(trajectory)
        paused(trajectory, progress)

    paused = once(due, wish("pause"), wish("resume"))
    result = play_plan(player, led, hardware, callback=seen, loop=loop)
    assert result.outcome is PlaybackOutcome.SUCCESS, result.message
    assert not controller.refused
    assert len(controller.arrivals) > 4
    goal = path[-1].positions(path[-1].duration)
    assert (abs(result.position - goal) <= player.device.resolution).all()
    assert abs(goal - hardware.positions(plan.robot, plan.q[-1])).max() > 0.01
    speed, limits = controller.steps[1], hardware.apply_limits(plan.robot).speed
    columns = [plan.robot.axes.index(name) for name in controller.names]
    assert (abs(speed).max(axis=0) < 1.05 * limits[columns] * np.where(np.array(columns) < 3, 1.0, 1e-3)).all()
    again = replay_session(led, hardware, read_journal(player.journal.path), Tracker(led, sensors))
    assert (again.differs, again.corrections > 3) == ("", True)


def test_it_goes_to_the_first_frame_from_elsewhere(stage, plan):
    controller, player, hardware = stage
    controller.position[controller.names.index("beta_3")] += 0.002
    result = play_plan(player, plan, hardware)
    assert result.outcome is PlaybackOutcome.SUCCESS, result.message
    assert len(controller.arrivals) == 2
    assert at_end(plan, hardware, controller) < 0.01


def test_a_pause_comes_to_rest_on_the_path_and_goes_on_gently(stage, plan):
    controller, player, hardware = stage
    moments = []

    def wish(name):
        return lambda: (moments.append(time.monotonic()), getattr(player, name)())

    def due(progress, k):
        if k:
            return player.state is PlayerState.HOLD and time.monotonic() > moments[0] + 0.6
        return progress.time > 0.5

    result = play_plan(player, plan, hardware, callback=once(due, wish("pause"), wish("resume")))
    assert result.outcome is PlaybackOutcome.SUCCESS, result.message
    assert at_end(plan, hardware, controller) < 0.01
    assert not controller.refused
    assert 0.05 < controller.rest_after(moments[0]) < 0.35
    frames = [r["frame"] for r in read_journal(player.journal.path) if r["kind"] == "frame"]
    assert frames == sorted(set(frames))
    assert frames[-1] == FRAMES
    trajectory = trajectory_of(plan, hardware)
    fine = trajectory.positions(np.linspace(0.0, trajectory.duration, 4000))
    ros = np.array([p for _, p in controller.track])[:, [controller.names.index(a.joint) for a in hardware.axes]]
    scale = np.array([a.scale * (1e3 if a.unit == "mm" else 1.0) for a in hardware.axes])
    axes = (ros * scale + [a.zero for a in hardware.axes]) / hardware.tolerance
    assert max(abs(fine / hardware.tolerance - p).max(axis=1).min() for p in axes) < 0.2
    speed = controller.steps[1]
    fastest = 1.35 * abs(trajectory.at(np.linspace(0.0, trajectory.duration, 500))[1][:, :6]).max(axis=0)
    columns = [plan.robot.axes.index(name) for name in controller.names]
    assert (abs(speed).max(axis=0) < fastest[columns] * np.where(np.array(columns) < 3, 1.0, 1e-3)).all()


def test_an_abort_stops_and_tells_where(stage, plan):
    controller, player, hardware = stage
    moments = []
    seen = once(lambda p, k: p.time > 0.5, lambda: (moments.append(time.monotonic()), player.abort()))
    result = play_plan(player, plan, hardware, callback=seen)
    assert result.outcome is PlaybackOutcome.CANCELLED
    assert result.trusted
    assert controller.rest_after(moments[0]) < 0.35
    ended = controller.position.copy()
    assert 1 <= result.frame < FRAMES
    slide = hardware.axes[2]
    assert result.position[2] == pytest.approx(1e3 * ended[controller.names.index(slide.joint)], abs=1e-3)
    time.sleep(0.2)
    assert (controller.position == ended).all()
    player.close()
    again = resume(player, plan, hardware, read_journal(player.journal.path))
    assert again.outcome is PlaybackOutcome.SUCCESS, again.message
    assert at_end(plan, hardware, controller) < 0.01


def spoil(name, value=True):
    """A fault that sets something of the controller."""
    return lambda controller: setattr(controller, name, value)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (spoil("silent"), rf"no fresh joint states have come for {MAX_JOINT_STATE_SILENCE_S}"),
        (spoil("frozen"), r"no fresh joint states"),
        (spoil("nan", "beta_2"), r"beta_2 is not a number"),
        (spoil("short"), r"7 names, 6 positions"),
        (spoil("missing"), r"has beta_3 0 times"),
        (spoil("delay", 0.8), r"no fresh joint states|later than they did at first"),
        (spoil("stuck"), r"tolerances from"),
    ],
    ids=["silent", "frozen", "nan", "short", "missing", "delay", "stuck"],
)
def test_what_goes_wrong_on_the_way_ends_in_a_fault(stage, plan, fault, says):
    controller, player, hardware = stage
    result = play_plan(player, plan, hardware, callback=once(lambda p, k: p.time > 0.3, lambda: fault(controller)))
    wanted = PlaybackOutcome.PATH_TOLERANCE_VIOLATED if "tolerances" in says else PlaybackOutcome.DEVICE_FAULT
    assert result.outcome is wanted, result.message
    assert re.search(says, result.message)
    assert result.frame < FRAMES
    time.sleep(0.3)
    speed = controller.steps[1][-1]
    assert (abs(speed) < 1e-6).all(), "the controller goes on although its player gave up"


def test_a_controller_that_does_not_follow_is_a_fault(stage, plan):
    controller, player, hardware = stage
    controller.deaf = True
    result = play_plan(player, plan, hardware)
    assert result.outcome is PlaybackOutcome.DEVICE_FAULT
    assert re.search(r"does not follow: it is 0\.\d+ s behind", result.message)


def test_a_controller_that_vanishes_is_a_fault(stage, plan):
    controller, player, hardware = stage
    result = play_plan(
        player, plan, hardware, callback=once(lambda p, k: p.time > 0.3, lambda: spoil("gone")(controller))
    )
    assert result.outcome is PlaybackOutcome.DEVICE_FAULT
    assert re.search("the controller is gone", result.message)


def test_nothing_is_begun_while_it_moves_but_it_can_be_stopped(stage, plan):
    controller, player, hardware = stage
    other = Ros2(hardware, player.journal, RealClock())
    other.connect()
    other.start(trajectory_of(plan, hardware).commands())
    time.sleep(0.1)
    with pytest.raises(DeviceFault, match="the joints move"):
        player.connect()
    player.close()
    began = time.monotonic()
    standing = player.connect(stop_first=True)
    assert controller.rest_after(began) < 0.5
    assert standing.position[0] == pytest.approx(
        1e3 * controller.position[controller.names.index("beta_1")], abs=1e-3
    )
    at, speed = controller.steps
    change = abs(np.diff(speed[at[:] > began], axis=0)).max(axis=0)
    assert (change < 0.3 * abs(speed).max(axis=0) + 1e-9).all(), "a jump in speed"
    other.close()


@pytest.mark.parametrize(("names_there", "says"), [(None, "nothing listens on"), (["elbow"], "only other, elbow")])
def test_who_is_not_there_is_named(plan, tmp_path, monkeypatch, names_there, says):
    monkeypatch.setattr("ctr_nlp.hardware.devices.ros2.device.DISCOVERY", 0.3)
    url = f"{next(names)}?domain={DOMAIN}"
    controller = Controller(url, dict.fromkeys(names_there, 0.0)) if names_there else None
    if controller:
        controller.start()
    journal = Journal(tmp_path / "journal.jsonl", RealClock())
    device = Ros2(rig(plan, url), journal, RealClock())
    with pytest.raises(DeviceFault, match=says):
        device.connect()
    device.close()
    journal.close()
    if controller:
        controller.close()


def test_a_controller_in_another_process_is_found_on_loopback_alone(plan, tmp_path):
    """Discovery by sockets; what sends is bound to 127.0.0.1, and no multicast group is joined."""
    url = f"{next(names)}?domain={(DOMAIN - 20 + 40) % 80 + 20}"
    here, joints = Path(__file__).resolve(), {name: float(value) for name, value in first(plan).items()}
    paths = [str(here.parent), str(here.parents[1])]
    code = f"import sys; sys.path[:0] = {paths}; import test_ros2 as t; t.serve({url!r}, {joints})"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE) as process:
        journal = Journal(tmp_path / "journal.jsonl", RealClock())
        hardware = rig(plan, url)
        player = Player(Ros2(hardware, journal, RealClock()), None, journal)
        groups = Path("/proc/net/igmp")
        before = groups.read_text() if groups.exists() else ""
        try:
            result = play_plan(player, plan, hardware)
            if before:
                assert groups.read_text().count("0100FFEF") == before.count("0100FFEF"), "239.255.0.1 was joined"
                assert set(own_sockets()) == {LOOPBACK, "0.0.0.0"}
        finally:
            player.device.close()
            journal.close()
            process.communicate(timeout=10)
    assert result.outcome is PlaybackOutcome.SUCCESS, result.message


def serve(url, joints):
    """Be a controller until standard input ends."""
    controller = Controller(url, joints)
    controller.start()
    sys.stdin.read()
    controller.close()


def own_sockets():
    """Address of each UDP socket of this process."""
    mine = {os.readlink(f.path) for f in os.scandir("/proc/self/fd") if os.path.islink(f.path)}
    for line in Path("/proc/net/udp").read_text().splitlines()[1:]:
        fields = line.split()
        if f"socket:[{fields[9]}]" in mine:
            yield ".".join(str(byte) for byte in reversed(bytes.fromhex(fields[1].partition(":")[0])))


def test_types_and_topics_are_those_of_ros(plan, stage):
    """As another participant discovers them."""
    from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription

    _, player, hardware = stage
    player.connect()
    own, _domain = participant(parse_controller_url(hardware.connection.url))
    found = set()
    for kind in (BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription):
        found |= {(e.topic_name, e.type_name) for e in BuiltinDataReader(own, kind).read(100)}
    name = hardware.connection.url.partition("?")[0]
    assert (f"rt/{name}/joint_trajectory", "trajectory_msgs::msg::dds_::JointTrajectory_") in found
    assert ("rt/joint_states", "sensor_msgs::msg::dds_::JointState_") in found


@pytest.fixture(scope="module")
def store():
    """Messages as rosbags knows them."""
    typesys = pytest.importorskip("rosbags.typesys")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


class TestBytes:
    """Messages as an independent serialiser writes them: CDR little-endian, with ROS's 4-byte header."""

    @pytest.mark.parametrize("joints", [["beta_1"], ["alpha_1", "b"], ["alpha_1", "beta_22", "x"]])
    def test_trajectory(self, store, joints):
        rng = np.random.default_rng(len(joints))
        made = Points(np.array([0.05, 1.999999999, 3.0]), *rng.normal(size=(2, 3, len(joints))))
        ours = trajectory_message(joints, made).serialize(use_version_2=False)
        kinds, nothing = store.types, np.zeros(0)
        duration = kinds["builtin_interfaces/msg/Duration"]
        listed = [
            kinds["trajectory_msgs/msg/JointTrajectoryPoint"](p, v, nothing, nothing, duration(*when))
            for p, v, when in zip(
                made.position, made.velocity, [(0, 5 * 10**7), (1, 999999999), (3, 0)], strict=True
            )
        ]
        header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](0, 0), "")
        theirs = kinds["trajectory_msgs/msg/JointTrajectory"](header, joints, listed)
        self.same(ours, store.serialize_cdr(theirs, "trajectory_msgs/msg/JointTrajectory"))

    def test_states_are_read(self, store):
        kinds = store.types
        header = kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](7, 8), "base")
        numbers = [np.array(values) for values in ([0.5, -2.0], [0.25, 3.0], [1.0])]
        theirs = kinds["sensor_msgs/msg/JointState"](header, ["alpha_1", "beta_1"], *numbers)
        data = bytes(store.serialize_cdr(theirs, "sensor_msgs/msg/JointState"))
        read = types().JointState.deserialize(data)
        assert read == types().JointState(
            types().Header(types().Time(7, 8), "base"), ["alpha_1", "beta_1"], *(n.tolist() for n in numbers)
        )
        self.same(read.serialize(use_version_2=False), data)

    @staticmethod
    def same(ours, theirs):
        """Bytes 3 and 4 are options, which readers of plain CDR skip."""
        assert bytes(ours)[:2] == bytes(theirs)[:2] == b"\x00\x01"
        assert bytes(ours)[4:] == bytes(theirs)[4:]


@pytest.fixture(scope="module")
def trajectory(plan):
    return trajectory_of(plan, rig(plan, "ctr"))


@pytest.fixture
def track(trajectory):
    return ControllerTrack(trajectory.positions(np.zeros(1))[0], trajectory.commands())


class TestTrack:
    """The path as the controller gets it, against the trajectory itself."""

    def test_it_is_the_trajectory(self, track, trajectory):
        at = np.linspace(0.0, trajectory.duration, 2000)
        away = abs(np.array([track.position(t) for t in at]) - trajectory.positions(at))
        assert (away / trajectory.hardware.tolerance).max() < 0.1

    @pytest.mark.parametrize("part", [0.02, 0.3, 0.77, 0.97])
    def test_a_hold_and_going_on_keep_to_it(self, track, trajectory, part):
        acceleration = np.array([axis.acceleration for axis in trajectory.hardware.axes])
        track.begin(0.0)
        moment = part * trajectory.duration
        track.turn(moment, 0.0, acceleration)
        held = track.points()
        stands, pace = track.now(moment + 2.0)
        assert pace == 0.0 or stands == track.end
        assert held.time[-1] <= 0.26
        assert held.position[-1] == pytest.approx(track.position(stands))
        if stands == track.end:
            return
        track.turn(5.0, 1.0, acceleration)
        rest = track.points()
        assert (np.diff(rest.time) > 0).all()
        assert not rest.velocity[-1].any()
        assert rest.position[-1] == pytest.approx(trajectory.commands().positions[-1])
        for frame in trajectory.positions(trajectory.frame_time[trajectory.frame_time > stands + 0.1]):
            assert abs(rest.position - frame).max(axis=1).min() < 1e-9, "a frame was lost"


@pytest.mark.parametrize(
    ("url", "means"),
    [
        ("ctr", ("ctr", "", 0)),
        ("/robot_1/ctr@192.168.1.5", ("robot_1/ctr", "192.168.1.5", 0)),
        ("ctr@box.local?domain=42", ("ctr", "box.local", 42)),
    ],
)
def test_addresses(url, means):
    assert parse_controller_url(url) == means
    assert parse_controller_url(url).states == ("robot_1/joint_states" if "robot_1" in url else "joint_states")


@pytest.mark.parametrize("url", ["1ctr", "ctr@", "ctr?domain=233", "ctr host", "socket://x:1", "ctr?domain=-1"])
def test_what_is_no_address_is_refused(url, plan):
    with pytest.raises(HardwareError, match="controller's name"):
        Ros2(rig(plan, url), None, RealClock())


def test_a_host_is_reached_from_its_interface_alone():
    assert f'address="{LOOPBACK}"' in configuration("127.0.0.2").split("<Peers>")[0]
    assert '<Peer address="127.0.0.2"/>' in configuration("127.0.0.2")
    with pytest.raises(DeviceFault, match=r"not-there\.invalid"):
        configuration("not-there.invalid")
