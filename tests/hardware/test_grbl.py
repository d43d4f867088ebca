"""The Grbl device on the emulated controller, in virtual time: what it accepts, how it streams, how it stops."""

from __future__ import annotations

import json
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import WireLink, World, homed_firmware, homing_hardware, plan_of, sweep
from emulator.faults import FAULTS
from emulator.firmware import Firmware
from hypothesis import given
from hypothesis import strategies as st

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.description import Connection
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.devices.grbl import stream
from ctr_nlp.hardware.devices.grbl.identity import find_loose_settings
from ctr_nlp.hardware.devices.grbl.talk import reply_of, report_of
from ctr_nlp.hardware.motion.trajectory import Trajectory
from ctr_nlp.hardware.playing.record import Recorder
from ctr_nlp.hardware.playing.results import PlaybackOutcome, PlayerState

pytestmark = pytest.mark.usefixtures("prepared_once")

STEP = np.array([1 / 400] * 3 + [1 / 100] * 3)
"""mm and deg of the emulated machine."""

Seen = Callable[[Trajectory, MotionProgress], None]


@pytest.mark.parametrize(
    ("text", "kind", "number"),
    [
        ("ok", "ok", 0),
        ("error:22", "error", 22),
        ("ALARM:3", "alarm", 3),
        ("GrblHAL 1.1f ['$' or '$HELP' for help]", "banner", 0),
        ("Grbl 1.1h ['$' for help]", "banner", 0),
        ("", "message", 0),
        ("[MSG:]", "message", 0),
        ("[G59.1:0.000,0.000,0.000,0.000,0.000,0.000]", "message", 0),
        ("$110=3000.000", "setting", 0),
        ("<Idle|MPos:0.000,0.000|Bf:100,1023|FS:0,0>", "report", 0),
        ("o\x8b", "unreadable", 0),
        ("okok", "unreadable", 0),
        ("error:", "unreadable", 0),
        ("<Idle|MPos:0.000", "unreadable", 0),
    ],
)
def test_lines_are_told_apart(text: str, kind: str, number: int) -> None:
    assert reply_of(text)[::2] == (kind, number)


def test_every_line_of_a_recorded_session_can_be_read(shared_data: Path) -> None:
    lines = (shared_data / "grblhal_transcript.txt").read_text(encoding="utf-8").splitlines()
    said = [line.split("<< ", 1)[1] if "<< " in line else "" for line in lines if "<<" in line]
    kinds = {text: reply_of(text).kind for text in said}
    assert "unreadable" not in kinds.values()
    reports = [report_of(text, 6) for text in said if kinds[text] == "report"]
    assert len(reports) > 150
    assert None not in reports


@pytest.mark.parametrize("digit", ["¹", "²", "³"])
def test_noise_that_looks_like_a_digit_is_no_number(digit: str) -> None:
    """Python takes these, of Latin-1, for digits, but not for numbers."""
    text = "<Run|MPos:0.000,0.000,0.000,0.000,0.000,0.000|Bf:{free},1023|Ln:{line}|FS:0,0|Ov:{override},100,100>"
    numbers = {"free": "11", "line": "17", "override": "100"}
    reports = {name: report_of(text.format(**numbers | {name: f"{digit}1"}), 6) for name in numbers}
    assert reports["line"] is None
    assert (reports["free"].free, reports["override"].override) == (None, None)


def test_a_report_tells_position_line_and_room() -> None:
    report = report_of("<Hold:0|MPos:-1.500,0.000,2.250,0.000,0.000,40.010|Bf:72,1023|Ln:17|FS:6,0|WCO:0,0>", 6)
    assert report is not None
    np.testing.assert_array_equal(report.position, [-1.5, 0, 2.25, 0, 0, 40.01])
    assert (report.state, report.stopped, report.line, report.free) == ("Hold", True, 17, 72)


@given(st.integers(0, 70), st.integers(0, 255), st.booleans())
def test_a_damaged_report_is_no_report_or_still_one_of_six_numbers(at: int, byte: int, lost: bool) -> None:
    text = "<Run|MPos:-17.000,-8.000,-2.000,150.000,-45.000,40.000|Bf:100,1023|FS:0,0>"
    damaged = text[:at] + ("" if lost else chr(byte)) + text[at + 1 :]
    report = report_of(damaged, 6)
    assert report is None or report.position.shape == (6,)


def world(tmp_path: Path, firmware: Firmware | None = None, **changes: Any) -> World:
    """A rig, with another controller or other parts."""
    return World(tmp_path, firmware=firmware or homed_firmware(), **changes)


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({110: 2999.0}, r"\$110 is 2999.* less than the speed of X in the hardware file.*: set \$110=3000"),
        ({125: 1000.0}, r"\$125 is 1000.* less than the acceleration of C .*: set \$125=2000"),
        ({13: 1}, r"reports in inches: set \$13=0"),
        ({20: 0}, r"soft limits are off, .*: set \$20=1"),
        ({22: 0}, r"homing is off, .*: set \$22=1"),
        ({1: 25}, r"motors X Y Z A B C go limp after 25 ms at rest, and lose their position: set \$1=255"),
        ({1: 254, 37: 0b110111}, r"motors A go limp after 254 ms .*: set \$1=255"),
        ({10: 447}, r"status reports lack overrides: set \$10=511"),
        ({10: 2}, r"lack machine positions, line numbers, overrides: set \$10=511"),
        ({32: 2}, r"a laser cutter or a lathe.*: set \$32=0"),
        ({39: 0}, r"a hold is not obeyed .*: set \$39=1"),
        ({62: 1}, r"goes to sleep by itself.*: set \$62=0"),
        ({162: 0.05}, r"backlash of Z, which must be left .*: set \$162=0"),
        ({1: 25, 13: 1}, r"1 more: `ctr-nlp commission` lists all"),
        ({11: 0.01}, r"\$11 is 0\.01.*quick rotations would be late.*: set \$11=0\.1"),
        ({11: 2.0}, r"\$11 is 2\.0.*steppers lose steps: set \$11=1"),
    ],
)
def test_a_controller_set_otherwise_is_refused(settings: dict[int, float], complaint: str, tmp_path: Path) -> None:
    rig = world(tmp_path)
    rig.firmware.settings.update(settings)
    with pytest.raises(DeviceFault, match=complaint):
        rig.begin()
    assert rig.firmware.executed_blocks == []


def test_what_bounds_a_changed_line_is_named() -> None:
    """The largest rates, and soft limits where there are any."""
    settings = {"110": "3000.000", "111": "3001.000", "130": "50.000", "132": "151.000", "133": "720.000"}
    homing, manual = homing_hardware(), homing_hardware(connection=Connection("grbl", "wire:"))
    told = [(one.name, one.wanted) for one in find_loose_settings(settings, range(6), homing)]
    assert told == [("111", "3000"), ("132", "150")]
    assert [one.name for one in find_loose_settings(settings, range(6), manual)] == ["111"]


def test_axes_that_the_controller_lacks_are_refused(tmp_path: Path) -> None:
    hardware = homing_hardware()
    renamed = replace(hardware, axes=(*hardware.axes[:5], replace(hardware.axes[5], letter="U")))
    with pytest.raises(DeviceFault, match="has axes XYZABC; the hardware wants U"):
        world(tmp_path, hardware=renamed).begin()


def test_slides_that_are_not_homed_are_refused_until_they_home(tmp_path: Path) -> None:
    rig = world(tmp_path, Firmware({20: 1, 22: 1} | {130 + i: 150.0 for i in range(3)}))
    with pytest.raises(DeviceFault, match="home"):
        rig.begin()
    assert rig.firmware.executed_blocks == []


def test_an_alarm_is_refused(tmp_path: Path) -> None:
    rig = world(tmp_path)
    rig.firmware.hard_limit()
    with pytest.raises(DeviceFault, match=r"controller is Alarm; it must be Idle"):
        rig.begin()


@pytest.mark.parametrize("flow", ["count", "wait"])
def test_400_frames_stream_in_20_seconds(flow: str, tmp_path: Path) -> None:
    t = np.linspace(0.0, 1.0, 400)[:, None]
    smooth = t**2 * (3 - 2 * t)
    alpha = np.hstack([1.5 * smooth, -2.0 * np.sin(3.0 * smooth), 1.2 * smooth])
    beta = np.hstack([5 + 30 * smooth, 10 + 80 * smooth, 15 + 120 * smooth])
    plan = plan_of(np.hstack([alpha, beta, np.zeros((400, 2))]), 0.05)
    hardware = homing_hardware(connection=Connection("grbl", "wire:", homing="cycle", flow=flow))
    rig, recorder, most = world(tmp_path, plan=plan, hardware=hardware), Recorder(), [0]

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        recorder(trajectory, progress)
        most[0] = max(most[0], rig.latest.device.stream.in_flight)

    result = rig.begin(callback=seen)
    assert result.outcome is PlaybackOutcome.SUCCESS
    tracking = recorder.tracking()
    assert tracking is not None
    took = tracking.time[-1] + tracking.late[-1]
    assert took == pytest.approx(20.0, rel=0.02)
    assert rig.latest.device.stream.underruns == 0
    assert rig.frames_played() == list(range(1, 401))
    goal = rig.trajectory().positions(np.array([rig.trajectory().duration]))[0]
    assert (abs(rig.firmware.position - goal) <= STEP).all()
    assert abs(tracking.error[:, :3]).max() < 0.5
    assert abs(tracking.error[:, 3:]).max() < 1.0
    assert most[0] <= (1024 - stream.SPARE_BUFFER_BYTES if flow == "count" else 2 * 100)  # a line and its copy
    assert rig.firmware.bytes_lost == 0


def test_frames_in_which_nothing_moves_take_their_time(tmp_path: Path) -> None:
    q = sweep(12).q
    still = np.vstack([q[:6], np.repeat(q[5:6], 5, axis=0), q[6:]])
    rig, recorder = world(tmp_path, plan=plan_of(still, 0.1)), Recorder()
    assert rig.begin(callback=recorder).outcome is PlaybackOutcome.SUCCESS
    tracking = recorder.tracking()
    assert tracking is not None
    assert abs(tracking.late).max() < 0.2
    assert (abs(np.array(rig.firmware.executed_blocks[-1][1]) - rig.firmware.position) <= STEP).all()


def moments(count: int) -> list[float]:
    draw = random.Random(7)
    return [draw.uniform(0.05, 1.6) for _ in range(count)]


@pytest.mark.parametrize("kind", ["pause", "abort"])
def test_holds_and_aborts_are_quick_and_keep_the_position(kind: str, tmp_path: Path) -> None:
    """At 50 random moments; 0.3 s for a hold, 0.5 s for an abort, from the call."""
    took, called, rest = [], [0.0], [0.0]
    for number, at in enumerate(moments(50)):
        folder = tmp_path / str(number)
        folder.mkdir()
        rig, called[0], rest[0] = world(folder), 0.0, 0.0

        def seen(trajectory: Trajectory, progress: MotionProgress, rig: World = rig, at: float = at) -> None:
            now = rig.clock.now()
            if len(trajectory.frames) > 2 and not called[0] and progress.time > at:
                called[0] = now
                getattr(rig.latest, kind)()
            if rig.latest.state is PlayerState.HOLD and not rest[0]:
                rest[0] = now
                assert not rig.firmware.motion.running
                rig.latest.abort()

        result = rig.begin(callback=seen)
        took.append((rest[0] or rig.clock.now()) - called[0])
        assert result.outcome is PlaybackOutcome.CANCELLED
        assert result.trusted
        np.testing.assert_allclose(result.position, rig.firmware.position, atol=2e-3)
        np.testing.assert_allclose(rig.firmware.slip, 0.0)
    assert max(took) < (0.3 if kind == "pause" else 0.5), f"median {np.median(took):.3f}, worst {max(took):.3f} s"


def test_a_hold_that_was_not_heard_is_repeated(tmp_path: Path) -> None:
    """Just after a resume the recorded firmware lets a hold pass."""
    rig, deaf = world(tmp_path), [2]

    def forget(data: bytes) -> bytes:
        if b"!" in data and deaf[0]:
            deaf[0] -= 1
            return data.replace(b"!", b"")
        return data

    asked: list[float] = []

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if len(trajectory.frames) > 2 and progress.time > 0.4 and not asked:
            rig.links[-1].wire.line.outward.append(forget)
            asked.append(rig.clock.now())
            rig.latest.pause()
        if rig.latest.state is PlayerState.HOLD:
            asked.append(rig.clock.now())
            rig.latest.abort()

    assert rig.begin(callback=seen).outcome is PlaybackOutcome.CANCELLED
    assert deaf[0] == 0
    assert asked[1] - asked[0] < 0.5


def test_a_held_controller_is_asked_for_its_status_and_nothing_else(tmp_path: Path) -> None:
    rig, sent = world(tmp_path), []

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if (
            len(trajectory.frames) > 2
            and progress.time > 0.4
            and rig.latest.state is PlayerState.RUNNING
            and not sent
        ):
            rig.latest.pause()
        if rig.latest.state is PlayerState.HOLD:
            sent.append(len(sent_by_host(rig)))
            if len(sent) == 300:
                rig.latest.resume()

    assert rig.begin(callback=seen).outcome is PlaybackOutcome.SUCCESS
    while_held = sent_by_host(rig)[sent[0] : sent[299]]
    assert len(while_held) > 20
    assert set(while_held) == {ord("?")}
    assert rig.frames_played() == list(range(1, 21))


@pytest.mark.parametrize("how", ["both", "alarm", "banner"])
def test_a_reset_in_motion_is_never_trusted(how: str, tmp_path: Path) -> None:
    """A controller that does not hear the hold is reset all the same, whatever it then says."""
    rig = world(tmp_path, plan=sweep(60))
    rig.firmware.on_reset = how

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if len(trajectory.frames) > 2 and progress.time > 2.0:
            rig.links[-1].wire.line.outward.append(lambda data: data.replace(b"!", b""))
            rig.latest.abort()

    result = rig.begin(callback=seen)
    rig.clock.sleep(5.0)
    assert result.outcome is PlaybackOutcome.CANCELLED
    assert not result.trusted
    assert rig.firmware.position[0] > rig.trajectory().positions(np.array([rig.trajectory().duration]))[0, 0] + 1.0
    assert b"$X" not in sent_by_host(rig)


def sent_by_host(rig: World) -> bytes:
    """All bytes that sessions on a rig recorded as sent."""
    records = [json.loads(line) for line in rig.path.read_bytes().splitlines()]
    return "".join(record["data"] for record in records if record["kind"] == "sent").encode("latin-1")


def test_a_controller_that_restarts_when_its_port_is_opened_does_not_go_on(tmp_path: Path) -> None:
    """Some boards reset with the port's control lines: after a crash that loses the position."""
    rig = world(tmp_path)

    def seen(trajectory: Trajectory, progress: MotionProgress) -> None:
        if len(trajectory.frames) > 2 and progress.time > 0.8:
            rig.latest.abort()

    assert rig.begin(callback=seen).trusted
    with pytest.raises(DeviceFault, match="restarted when it was connected"):
        rig.resume((FAULTS["banner"](at=rig.firmware.time + 0.004, choice=0.0),))


def test_half_a_line_that_a_lost_link_left_is_not_completed_by_the_next_session(tmp_path: Path) -> None:
    rig = world(tmp_path)
    rig.firmware.receive(b"G21 G90 G93 G1 X-30 F2")
    assert rig.begin().outcome is PlaybackOutcome.SUCCESS
    assert all(number is not None for number, _ in rig.firmware.executed_blocks)


def test_a_controller_that_reports_work_positions_is_refused(tmp_path: Path) -> None:
    rig = world(tmp_path)
    opened = WireLink.read

    def work_positions(link: WireLink) -> bytes:
        return opened(link).replace(b"|MPos:", b"|WPos:")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(WireLink, "read", work_positions)
        with pytest.raises(DeviceFault, match=r"must report MPos: set \$10=511"):
            rig.begin()
