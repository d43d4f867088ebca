"""Exported files: a trajectory's numbers as readers that are not ours see them, and nothing on bad input."""

from __future__ import annotations

import csv
import io
import re
import signal
import sqlite3
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import BPoly, CubicHermiteSpline
from urscript import play

from ctr_nlp import Plan, Problem, curve_from_formula, growing, table_i_robot
from ctr_nlp.cli.commands import export as export_commands
from ctr_nlp.cli.commands.export import main
from ctr_nlp.cli.output.folder import MARK
from ctr_nlp.exceptions import HardwareError, OptionError
from ctr_nlp.hardware.arm.kinematics import tilt_of_joints
from ctr_nlp.hardware.description import Hardware, simulated_hardware
from ctr_nlp.hardware.exports import MACHINE_FORMATS, MACHINE_TEXT_FORMATS, csv_text
from ctr_nlp.hardware.exports.rosbag2 import (
    BAG_INTERPOLATION_TOLERANCE_MM,
    JOINT_STATES_TOPIC,
    JOINT_TRAJECTORY_TOPIC,
    STORAGES,
    points,
    write_bag,
)
from ctr_nlp.hardware.motion.gcode import LEAST_FEED, MODES, gcode_text
from ctr_nlp.hardware.motion.trajectory import trajectory_of
from ctr_nlp.hardware.playing.checks import check_trajectory
from ctr_nlp.hardware.playing.session import prepare_trajectory
from ctr_nlp.plan.plan import plan_from_configurations

pytest.importorskip("toppra")

FRAMES = 13
HELD = slice(5, 9)
"""Frames between which nothing moves."""


def made(model="dominant", tilt=True):
    """A plan that inserts, turns there and back, stands still and goes on, faster than the bench can."""
    robot = table_i_robot() if tilt else table_i_robot().with_locked_tilt()
    t = np.linspace(0, 1, FRAMES)
    t[HELD] = t[HELD.start]
    t[HELD.stop :] -= t[HELD.stop] - t[HELD.start] - 1 / FRAMES
    turn = 0.4 * np.sin(5 * t)
    alpha = [turn, 0.5 * turn - 0.1, 2.7 - turn]
    beta = [0 * t, 10 + 30 * t, 20 + 55 * t]
    theta = [0.1 * t * tilt, -0.2 * t**2 * tilt]
    path = curve_from_formula(lambda u: (0.001 * u**2, 0.0, u), 0.0, 140.0)
    problem = Problem("M3 (odd) name!", robot, growing(path, FRAMES), duration=0.09 * FRAMES)
    nothing = np.zeros(FRAMES)
    meta = {"model": model, "failures": {}, "options": {}, "interrupted": False}
    return plan_from_configurations(
        problem,
        np.stack([*alpha, *beta, *theta], axis=1),
        meta,
        success=np.ones(FRAMES, dtype=bool),
        solve_time=nothing,
        objective=nothing,
        kkt=nothing,
    )


@pytest.fixture(scope="module")
def plan():
    return made()


@pytest.fixture(scope="module")
def locked():
    return made(tilt=False)


@pytest.fixture(scope="module")
def odd(plan):
    """Hardware with axes that count the other way, from elsewhere, in radians and with play."""
    rig = simulated_hardware(plan.robot)
    axes = list(rig.axes)
    axes[2] = replace(axes[2], sign=-1, zero=160.0, range=(0.0, 170.0))
    axes[3] = replace(axes[3], unit="rad", range=(-20.0, 20.0), speed=5.0, acceleration=20.0, backlash=0.02)
    return replace(rig, axes=tuple(axes))


@pytest.fixture(scope="module")
def trajectory(plan):
    return trajectory_of(plan, simulated_hardware(plan.robot))


@pytest.fixture(scope="module")
def still(locked):
    """A trajectory without a tilt, for hardware without an arm."""
    return trajectory_of(locked, replace(simulated_hardware(locked.robot), arm=None))


@pytest.fixture
def file(plan, tmp_path):
    (tmp_path / "in").mkdir()
    plan.save(tmp_path / "in" / "plan.npz")
    return tmp_path / "in" / "plan.npz"


def export(*arguments):
    return main([str(argument) for argument in arguments])


def described(rig):
    """The axes of some hardware as TOML, without its arm."""
    return "\n".join(
        f'[[axes]]\njoint = "{axis.joint}"\nletter = "{axis.letter}"\nunit = "{axis.unit}"\nzero = {axis.zero}\n'
        f"range = {list(axis.range)}\nspeed = {axis.speed}\nacceleration = {axis.acceleration}"
        for axis in rig.axes
    )


def everything(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


# the table


def read_table(text):
    rows = list(csv.DictReader(io.StringIO(text)))
    return {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}


def test_the_table_passes_every_frame_of_the_plan(plan, trajectory):
    table = read_table(csv_text(trajectory))
    there = table["at_frame"] == 1
    assert table["frame"][there].tolist() == list(range(1, FRAMES + 1))
    assert table["time_s"][there] == pytest.approx(trajectory.frame_time, abs=1e-8)
    assert table["time_s"][0] == 0
    for i in range(3):
        assert table[f"alpha_{i + 1}_rad"][there] == pytest.approx(plan.alpha[:, i], abs=1e-8)
        assert table[f"beta_{i + 1}_mm"][there] == pytest.approx(plan.beta[:, i], abs=1e-8)
        assert table[f"{'XYZ'[i]}_mm"][there] == pytest.approx(plan.beta[:, i], abs=1e-8)
        assert table[f"{'ABC'[i]}_deg"][there] == pytest.approx(np.degrees(plan.alpha[:, i]), abs=1e-6)
    for i, name in enumerate(("theta_x_rad", "theta_y_rad")):
        assert table[name][there] == pytest.approx(plan.theta[:, i], abs=1e-8)
    assert set(np.diff(table["frame"])) == {0, 1}


def test_axes_count_as_the_hardware_says_and_make_up_for_play(plan, odd):
    table = read_table(csv_text(trajectory_of(plan, odd)))
    assert table["Z_mm"] == pytest.approx(160 - table["beta_3_mm"], abs=1e-8)
    added = table["A_rad"] - table["alpha_1_rad"]
    there = table["at_frame"] == 1
    down = np.append(False, np.diff(plan.alpha[:, 0]) < 0)
    moving = np.append(False, abs(np.diff(plan.alpha[:, 0])) > 0.002)
    assert added[there][moving] == pytest.approx(-0.02 * down[moving], abs=1e-8)
    assert {round(value, 6) for value in added[there]} == {0.0, -0.02}


def test_speeds_and_accelerations_of_the_table_are_within_limits_and_those_that_were_checked(trajectory):
    table = read_table(csv_text(trajectory))
    time = table["time_s"]
    limits = {"mm": (50.0, 200.0), "deg": (np.degrees(2.0), 2000.0)}
    used = []
    for name in [name for name in table if name[0] in "XYZABC"]:
        speed, acceleration = limits[name.split("_")[1]]
        rate = np.diff(table[name]) / np.diff(time)
        change = 2 * np.diff(rate) / (time[2:] - time[:-2])
        used.append((abs(rate).max() / speed, abs(change).max() / acceleration))
    assert np.max(used) <= 1 + 1e-5
    found = check_trajectory(trajectory)
    assert np.max(used, axis=0) == pytest.approx([found.speed, found.acceleration], rel=0.15)
    assert time[-1] > (FRAMES - 1) * 0.09


# G-code


def moves(text, letters="XYZABC"):
    """(number, positions, seconds) of every numbered line, read by pygcode."""
    pygcode = pytest.importorskip("pygcode")
    found, position = [], None
    for row in text.splitlines():
        words = {word.letter: word.value for word in pygcode.Line(row).block.words}
        if "N" not in words:
            continue
        if words["G"] == 4:
            found.append((words["N"], position, words["P"]))
        else:
            assert words["G"] == 1
            position = [words[letter] for letter in letters]
            found.append((words["N"], position, 60 / words["F"]))
    return [np.array(part) for part in zip(*found, strict=True)]


def test_pygcode_reads_the_positions_and_times_of_the_trajectory(plan, odd):
    for rig in (simulated_hardware(plan.robot), odd):
        trajectory = trajectory_of(plan, rig)
        commands = trajectory.commands()
        number, position, seconds = moves(gcode_text(trajectory, "a"))
        assert number.tolist() == list(range(len(commands.time) + 1))
        assert position[0] == pytest.approx(trajectory.positions(np.zeros(1))[0], abs=0.6e-4)
        assert np.cumsum(seconds[1:]) == pytest.approx(commands.time, abs=5e-4)
        assert position[1:] == pytest.approx(commands.positions, abs=LEAST_FEED * 0.05 + 1e-4)
        assert position[-1] == pytest.approx(rig.positions(trajectory.robot, plan.q[-1]), abs=0.021)


def test_gcodeparser_reads_the_same_and_no_command_in_the_comments(trajectory):
    gcodeparser = pytest.importorskip("gcodeparser")
    text = gcode_text(trajectory, "G28 (M3) T1")
    with pytest.warns(DeprecationWarning, match="parse_gcode_lines"):
        read = gcodeparser.GcodeParser(text).lines
    said = [line.command_str for line in read]
    begun = [*MODES.split(), "M0", "G1", "M0"]
    lines = len(trajectory.commands().time)
    assert said[: len(begun)] == begun
    assert said[-2:] == ["G94", "M2"]
    assert len(said) == len(begun) + lines + 2
    assert set(said[len(begun) : -2]) == {"G1", "G4"}
    number, position, seconds = moves(text)
    ours = [line for line in read if line.command_str in ("G1", "G4")]
    for line, place, duration in zip(ours, position, seconds, strict=True):
        if line.command_str == "G1":
            assert [line.get_param(letter) for letter in "XYZABC"] == place.tolist()
            assert 60 / line.get_param("F") == pytest.approx(duration)
        else:
            assert line.get_param("P") == duration
    assert number[-1] == lines


def per_minute_seconds(text, letters, linear, feed):
    """Seconds of every numbered line from N1 on, also of those that wait, read by gcodeparser."""
    gcodeparser = pytest.importorskip("gcodeparser")
    with pytest.warns(DeprecationWarning, match="parse_gcode_lines"):
        read = gcodeparser.GcodeParser(text).lines
    numbered = text[: text.index("N1 ")].count("N0 ")
    there, found = {}, []
    for line in read:
        if line.command_str == "G4":
            found.append(line.get_param("P"))
        if line.command_str != "G1":
            continue
        place = {letter: line.get_param(letter) for letter in letters if line.get_param(letter) is not None}
        change = np.array([place[letter] - there.get(letter, np.nan) for letter in place])
        counted = [letter in linear for letter in place]
        if feed == "per-minute-linear" and np.any(change[counted]):
            change = change[counted]
        there |= place
        found.append(60 * np.linalg.norm(change) / line.get_param("F"))
    return np.array(found[numbered:]), read


@pytest.mark.parametrize("feed", ["per-minute", "per-minute-linear"])
def test_feeds_per_minute_take_the_time_of_inverse_time(plan, odd, feed):
    """Counted as Grbl does, along all axes, or as LinuxCNC and Marlin do, along the axes in mm."""
    for rig in (simulated_hardware(plan.robot), odd):
        trajectory = trajectory_of(plan, rig)
        letters = trajectory.hardware.letters
        linear = [axis.letter for axis in rig.axes if axis.unit == "mm"]
        text = gcode_text(trajectory, "a", feed)
        seconds, read = per_minute_seconds(text, letters, linear, feed)
        _, _, expected = moves(gcode_text(trajectory, "a"))
        assert seconds == pytest.approx(expected[1:], rel=1e-3, abs=1e-4)
        assert seconds.sum() == pytest.approx(trajectory.commands().time[-1], rel=1e-4)
        modes = [line.command_str for line in read if line.command_str in ("G93", "G94")]
        assert modes == ["G94", "G94"]


@pytest.mark.parametrize("feed", ["per-minute", "per-minute-linear"])
def test_the_approach_with_feeds_per_minute_is_slow_for_every_axis(trajectory, feed):
    text = gcode_text(trajectory, "a", feed)
    rows = [row for row in text.splitlines() if row.startswith("N0 ")]
    feeds = [float(row.rpartition("F")[2]) for row in rows]
    units = {axis.letter: axis.unit for axis in trajectory.hardware.axes}
    assert [{units[letter] for letter in re.findall(r"[XYZABC]", row)} for row in rows] == [{"mm"}, {"deg"}]
    assert feeds == pytest.approx([60 * 0.2 * 50.0, 60 * 0.2 * np.degrees(2.0)], rel=1e-3)


def test_the_file_says_what_its_feeds_mean(trajectory):
    assert "--feed per-minute" in gcode_text(trajectory, "a")
    assert "degrees counted like mm" in gcode_text(trajectory, "a", "per-minute")
    assert "axes in mm alone" in gcode_text(trajectory, "a", "per-minute-linear")


def test_standing_still_takes_its_time(plan, trajectory):
    """Grbl drops a line in which nothing moves: only a dwell takes as long as it should."""
    text = gcode_text(trajectory, "a")
    held = trajectory.frame_time[HELD.stop - 1] - trajectory.frame_time[HELD.start]
    dwells = [float(found) for found in re.findall(r"^N\d+ G4 P([\d.]+)$", text, re.MULTILINE)]
    assert sum(dwells) >= held - 0.01
    assert held > 0.2
    _, position, seconds = moves(text)
    gone = np.linalg.norm(np.diff(position, axis=0), axis=1)
    fed = np.array([" G1 " in row for row in text.splitlines() if row.startswith("N")])[1:]
    assert (gone[fed] / seconds[1:][fed])[:-1].min() >= LEAST_FEED - 1e-3


def test_the_first_frame_is_gone_to_slowly_from_anywhere_after_a_pause(plan, trajectory):
    rows = [row for row in gcode_text(trajectory, "a").splitlines() if not row.startswith("(")]
    assert rows[1] == rows[3] == "M0"
    _, position, seconds = moves("\n".join(rows))
    for axis, start in zip(trajectory.hardware.axes, position[0], strict=True):
        largest = {"mm": 50.0, "deg": np.degrees(2.0)}[axis.unit]
        for end in axis.range:
            assert abs(start - end) / seconds[0] <= 0.2 * largest * (1 + 1e-4)


def test_the_file_says_whether_a_tilt_is_missing(trajectory, still):
    assert "TILT" in gcode_text(trajectory, "a")
    assert "urscript" in gcode_text(trajectory, "a")
    assert "TILT" not in gcode_text(still, "a")


def test_a_title_cannot_command_a_controller(trajectory):
    """Grbl obeys ? ! ~ and bytes from 128 on wherever they are, even in comments."""
    text = gcode_text(trajectory, "a) M3 (b\nG0 X9 ; ~!?%$ \x18 é")
    assert text.isascii()
    assert not set(text) & set("?!~%$;\x18")
    for row in text.splitlines():
        if row.startswith("("):
            assert re.fullmatch(r"\([^()]*\)", row)
            assert not re.search(r"[GMT]\d", row.upper())
        else:
            assert re.fullmatch(rf"{MODES}|M0|G94|M2|N\d+ G4 P[\d.]+|N\d+ G1( [A-Z]-?[\d.]+)+", row)
            assert len(row.replace(" ", "")) < 80  # what Grbl's line buffer holds


# the arm


def test_the_arm_program_tilts_as_the_plan_does(plan, trajectory):
    text = MACHINE_TEXT_FORMATS["urscript"].of(trajectory, "a b")
    assert text.startswith("def ctr_nlp_a_b():")
    count = int(np.ceil(trajectory.duration / 0.008)) + 1
    joints = play(text).samples[:count]
    assert len(joints) == count
    theta = tilt_of_joints(trajectory.hardware.arm, joints)
    time = 0.008 * np.arange(len(joints))
    for k in range(2):
        assert np.interp(trajectory.frame_time, time, theta[:, k]) == pytest.approx(plan.theta[:, k], abs=2e-4)
    assert theta[-1] == pytest.approx(plan.theta[-1], abs=1e-6)


def test_hardware_without_an_arm_has_no_arm_trajectory(still):
    with pytest.raises(HardwareError, match="no arm"):
        MACHINE_TEXT_FORMATS["urscript"].of(still, "a")


# the bag


def written(trajectory, tmp_path, storage):
    pytest.importorskip("rosbags")
    write_bag(trajectory, "a", tmp_path / "bag", storage)
    return tmp_path / "bag"


def in_rosbags(folder):
    """{topic: [(ns, message)]}, with the types that the bag itself describes."""
    from rosbags.rosbag2 import Reader
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    found = {}
    with Reader(folder) as bag:
        store = get_typestore(Stores.EMPTY)
        for connection in bag.connections:
            kinds = get_types_from_msg(connection.msgdef.data, connection.msgtype)
            store.register({kind: fields for kind, fields in kinds.items() if kind not in store.fielddefs})
        for connection, stamp, data in bag.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            found.setdefault(connection.topic, []).append((stamp, message))
    return found


def as_arrays(message):
    time = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points])
    parts = ("positions", "velocities", "accelerations")
    return time, *(np.array([getattr(p, name) for p in message.points]) for name in parts)


def test_a_bag_names_its_plan(trajectory, tmp_path):
    """Under the keys that readers of bags know."""
    told = (written(trajectory, tmp_path, "mcap") / "metadata.yaml").read_text(encoding="utf-8")
    assert re.search(r"ctr_nlp\.plan: ['\"]?a\b", told)
    assert "ctr_nlp.digest:" in told
    assert trajectory.digests.plan in told


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_holds_the_trajectory_in_si_units(plan, trajectory, tmp_path, storage):
    read = in_rosbags(written(trajectory, tmp_path, storage))
    ((stamp, message),) = read[JOINT_TRAJECTORY_TOPIC]
    assert stamp == 0
    assert message.joint_names == [f"{k}_{i}" for k in ("alpha", "beta") for i in (1, 2, 3)] + [
        "theta_x",
        "theta_y",
    ]
    time, position, velocity, acceleration = as_arrays(message)
    meant = np.hstack([plan.alpha, plan.beta / 1000, plan.theta])
    at = [int(abs(time - t).argmin()) for t in trajectory.frame_time]
    assert time[at] == pytest.approx(trajectory.frame_time, abs=1e-8)
    assert position[at] == pytest.approx(meant, abs=1e-9)
    inner = time[1:-1]
    step = 1e-5
    si = np.array([1, 1, 1, 1e-3, 1e-3, 1e-3, 1, 1])
    before, after = (si * trajectory.at(inner + sign * step)[0] for sign in (-1, 1))
    assert velocity[1:-1] == pytest.approx((after - before) / (2 * step), abs=2e-4)
    rate = (si * trajectory.at(inner + 1e-6)[1] - velocity[1:-1]) / 1e-6
    assert acceleration[1:-1] == pytest.approx(rate, abs=1e-2)
    assert abs(velocity[[0, -1]]).max() < 1e-7  # controllers refuse more at the end


@pytest.mark.parametrize("storage", STORAGES)
def test_a_bag_holds_the_states_of_every_command(trajectory, tmp_path, storage):
    states = in_rosbags(written(trajectory, tmp_path, storage))[JOINT_STATES_TOPIC]
    commands = trajectory.commands()
    stamps = np.array([stamp for stamp, _ in states])
    assert stamps[0] == 0
    assert stamps[1:] == pytest.approx(commands.time * 1e9, abs=1)
    for k, (stamp, state) in enumerate(states):
        assert state.header.stamp.sec * 10**9 + state.header.stamp.nanosec == stamp
        assert len(state.name) == len(state.position) == len(state.velocity) == 8
        if k:
            q = trajectory.at(commands.time[k - 1])[0]
            assert state.position[3:6] * 1000 == pytest.approx(q[3:6])
            assert np.delete(state.position, [3, 4, 5]) == pytest.approx(np.delete(q, [3, 4, 5]))


def test_the_mcap_file_explains_itself_to_another_reader(trajectory, tmp_path):
    """Only the mcap project's reader, and the message definitions in the file."""
    reader = pytest.importorskip("mcap.reader")
    decoder = pytest.importorskip("mcap_ros2.decoder")
    folder = written(trajectory, tmp_path, "mcap")
    with open(folder / "bag.mcap", "rb") as file:
        messages = list(
            reader.make_reader(file, decoder_factories=[decoder.DecoderFactory()]).iter_decoded_messages()
        )
    assert {schema.name for schema, *_ in messages} == {
        "trajectory_msgs/msg/JointTrajectory",
        "sensor_msgs/msg/JointState",
    }
    (found,) = (message for _, channel, _, message in messages if channel.topic == JOINT_TRAJECTORY_TOPIC)
    ((_, other),) = in_rosbags(folder)[JOINT_TRAJECTORY_TOPIC]
    for ours, theirs in zip(as_arrays(found), as_arrays(other), strict=True):
        assert np.array_equal(ours, theirs)
    states = [message for _, channel, _, message in messages if channel.topic == JOINT_STATES_TOPIC]
    assert len(states) == len(trajectory.commands().time) + 1
    assert states[-1].position[5] == pytest.approx(trajectory.at(trajectory.duration)[0][5] / 1000)


def test_the_sqlite_file_has_the_tables_of_ros(trajectory, tmp_path):
    folder = written(trajectory, tmp_path, "sqlite3")
    with sqlite3.connect(folder / "bag.db3") as base:
        topics = base.execute("SELECT name, type, serialization_format FROM topics ORDER BY id").fetchall()
        (count,) = base.execute("SELECT count(*) FROM messages").fetchone()
        kinds = [kind for (kind,) in base.execute("SELECT topic_type FROM message_definitions ORDER BY id")]
    base.close()
    assert topics == [
        (JOINT_TRAJECTORY_TOPIC, "trajectory_msgs/msg/JointTrajectory", "cdr"),
        (JOINT_STATES_TOPIC, "sensor_msgs/msg/JointState", "cdr"),
    ]
    assert kinds == [kind for _, kind, _ in topics]
    assert count == len(trajectory.commands().time) + 2


def test_interpolating_between_points_follows_the_trajectory(trajectory):
    """As joint_trajectory_controller does: cubic with velocities, quintic with accelerations too."""
    time, q, velocity, acceleration = points(trajectory)
    dense = np.linspace(0, trajectory.duration, 4001)
    true, mm = trajectory.at(dense)[0], np.array([10.0] * 3 + [1.0] * 3 + [10.0] * 2)

    def away(time, q, velocity, acceleration):
        cubic = CubicHermiteSpline(time, q, velocity)(dense)
        quintic = BPoly.from_derivatives(time, np.stack([q, velocity, acceleration], axis=1))(dense)
        return [(abs(curve - true) * mm).max() for curve in (cubic, quintic)]

    assert max(away(time, q, velocity, acceleration)) <= 1.1 * BAG_INTERPOLATION_TOLERANCE_MM
    frames = np.isin(time, trajectory.frame_time)
    assert frames.sum() == FRAMES
    assert (
        min(away(time[frames], q[frames], velocity[frames], acceleration[frames]))
        > 2 * BAG_INTERPOLATION_TOLERANCE_MM
    )


def test_without_an_arm_a_bag_has_no_tilt(still, tmp_path):
    read = in_rosbags(written(still, tmp_path, "mcap"))
    assert read[JOINT_TRAJECTORY_TOPIC][0][1].joint_names[-1] == "beta_3"
    assert {len(state.position) for _, state in read[JOINT_STATES_TOPIC]} == {6}
    assert {len(point.positions) for point in read[JOINT_TRAJECTORY_TOPIC][0][1].points} == {6}


def test_bags_are_kept_in_what_ros_knows(trajectory, tmp_path):
    with pytest.raises(OptionError, match="mcap or sqlite3"):
        write_bag(trajectory, "a", tmp_path / "bag", "rosbag1")
    assert not everything(tmp_path)


# the trajectory


@pytest.mark.parametrize("to", MACHINE_FORMATS)
def test_a_plan_becomes_a_file_beside_it(file, capsys, to):
    assert export(file, "--to", to) == 0
    out = capsys.readouterr().out
    if to == "rosbag2":
        names = {"plan_bag", "plan_bag/metadata.yaml", "plan_bag/plan_bag.mcap", f"plan_bag/{MARK}"}
        assert set(in_rosbags(file.with_name("plan_bag"))) == {JOINT_TRAJECTORY_TOPIC, JOINT_STATES_TOPIC}
    else:
        names = {f"plan{MACHINE_TEXT_FORMATS[to].suffix}"}
    assert everything(file.parent) == {"plan.npz"} | names
    assert f"wrote {file.with_name('plan')}" in out
    assert str(FRAMES) in out
    assert "stability" not in out
    before = [path.read_bytes() for path in sorted(file.parent.rglob("*")) if path.is_file()]
    assert export(file, "--to", to) == 0
    assert [path.read_bytes() for path in sorted(file.parent.rglob("*")) if path.is_file()] == before


def test_hardware_and_tempo_change_what_is_written(locked, tmp_path):
    file = tmp_path / "plan.npz"
    locked.save(file)
    rig = replace(
        simulated_hardware(locked.robot),
        axes=[replace(axis, zero=0.5, range=(-1100.0, 1100.0)) for axis in simulated_hardware(locked.robot).axes],
    )
    (tmp_path / "rig.toml").write_text(described(rig))
    assert (
        export(file, "--to", "csv", "--hardware", tmp_path / "rig.toml", "--tempo", 0.5, "--out", tmp_path / "a")
        == 0
    )
    table = read_table((tmp_path / "a").read_text())
    assert table["X_mm"] == pytest.approx(table["beta_1_mm"] + 0.5)
    assert table["time_s"][-1] >= 2 * 0.09 * (FRAMES - 1)


def test_an_elastic_plan_tells_its_margin(tmp_path, capsys):
    plan = made("elastic")
    plan.save(tmp_path / "plan.npz")
    assert export(tmp_path / "plan.npz", "--to", "csv") == 0
    told = float(re.search(r"least stability margin\D+([\d.]+)", capsys.readouterr().out)[1])
    assert 0 < told < 0.99
    assert told == pytest.approx(np.nanmin(plan.stability_between), abs=0.05)


def test_a_file_that_is_not_ours_is_left_alone(file, capsys):
    before = file.read_bytes()
    assert export(file, "--to", "gcode", "--out", file) == 2
    assert "was not written by ctr-nlp" in capsys.readouterr().err
    assert file.read_bytes() == before
    other = file.with_name("bag")
    other.mkdir()
    (other / "metadata.yaml").write_text("of somebody else")
    assert export(file, "--to", "rosbag2", "--out", other) == 2
    assert (other / "metadata.yaml").read_text() == "of somebody else"
    (file.parent / "empty").touch()
    assert export(file, "--to", "csv", "--out", file.parent / "empty") == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--to", "csv", "--tempo", "0"], r"tempo is 0\.0; it must lie in \(0, 1\]"),
        (["--to", "csv", "--tempo", "nan"], "tempo is nan"),
        (["--to", "csv", "--storage", "mcap"], "--storage goes with --to rosbag2"),
        (["--to", "rosbag2", "--out", "motion.mcap"], "a bag is a folder: motion will hold"),
        (["--to", "csv", "--hardware", "none.toml"], "none.toml"),
        (["--to", "csv", "--out", "plan.npz/motion.csv"], "cannot be written"),
        (["--to", "rosbag2", "--out", "plan.npz/motion"], "cannot be written"),
        (["--to", "csv", "--feed", "per-minute"], "--feed goes with --to gcode; a csv file has no feeds"),
        (["--to", "gcode", "--out", "."], "folder or a link"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_options_are_named_and_nothing_is_written(file, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(file.parent)
    assert export(file, *arguments) == 2
    assert re.search(message, capsys.readouterr().err)
    assert everything(file.parent) == {"plan.npz"}


def test_an_unknown_format_is_refused_with_those_there_are(file, capsys):
    with pytest.raises(SystemExit) as ended:
        export(file, "--to", "dxf")
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert all(name in said for name in MACHINE_FORMATS)


@pytest.mark.parametrize("to", MACHINE_FORMATS)
def test_plans_that_must_not_be_played_are_not_written(plan, tmp_path, capsys, to):
    unsolved = plan.success.copy()
    unsolved[3] = False
    turned = plan.alpha.copy()
    turned[4:, 0] += 2.0
    (tmp_path / "rig.toml").write_text(described(simulated_hardware(plan.robot)))
    assert Hardware.from_toml(tmp_path / "rig.toml").arm is None
    for bad, options, message in (
        (replace(plan, success=unsolved), [], "frame 4: the plan has no solution; all frames must be solved"),
        (replace(plan, alpha=turned), [], "frame 5: alpha_1 changes by"),
        (plan, ["--hardware", tmp_path / "rig.toml"], r"theta_x of frame 2 .* must lie in \[0, 0\]"),
    ):
        bad.save(tmp_path / "plan.npz")
        before = everything(tmp_path)
        assert export(tmp_path / "plan.npz", "--to", to, *options) == 2
        assert re.search(message, capsys.readouterr().err)
        assert everything(tmp_path) == before


@pytest.mark.parametrize(("to", "module"), [("rosbag2", "rosbags.rosbag2"), ("csv", "toppra")])
def test_a_missing_library_is_named_with_the_command_that_brings_it(file, monkeypatch, capsys, to, module):
    monkeypatch.setitem(sys.modules, module, None)
    assert export(file, "--to", to) == 2
    printed = capsys.readouterr().err
    assert f"{module} is not installed; this command installs it: " in printed
    assert '-m pip install "ctr_nlp[hardware]"' in printed
    assert everything(file.parent) == {"plan.npz"}


@pytest.mark.parametrize("to", ["csv", "rosbag2"])
def test_what_goes_wrong_while_writing_leaves_what_was_there(file, monkeypatch, capsys, to):
    assert export(file, "--to", to) == 0
    before = {path: path.read_bytes() for path in file.parent.rglob("*") if path.is_file()}

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", full)
    assert export(file, "--to", to, "--tempo", "0.5") == 2
    assert "No space left" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in file.parent.rglob("*") if path.is_file()} == before


def test_an_interrupted_export_writes_nothing(file, monkeypatch, capsys):
    def interrupted(*arguments):
        signal.raise_signal(signal.SIGINT)
        return prepare_trajectory(*arguments)

    monkeypatch.setattr(export_commands, "prepare_trajectory", interrupted)
    assert export(file, "--to", "csv") == 130
    assert "nothing was written" in capsys.readouterr().err
    assert everything(file.parent) == {"plan.npz"}


def test_what_is_not_a_plan_is_refused(tmp_path, capsys):
    (tmp_path / "plan.npz").write_text("no")
    assert export(tmp_path / "plan.npz", "--to", "csv") == 2
    assert "is not a plan" in capsys.readouterr().err
    assert isinstance(made(), Plan)
