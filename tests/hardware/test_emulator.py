"""The emulated controller against a session recorded from real firmware, and against itself under faults."""

import contextlib
import os
import random
import re
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from emulated import Host, program
from emulator import FAULTS, Firmware, Wire, fault, serving
from emulator.planner import BLOCKS

from ctr_nlp.exceptions import OptionError

pytestmark = pytest.mark.real_time

RECORDED = re.compile(r" *(\d+\.\d+) (>>|<<|==) (.*)")
TICK_S = 0.02
"""The recorded firmware looked at its input every 20 ms, so when a byte took effect is known no better."""


def recorded_groups():
    """(title, [(time, mark, text)]) of each group of the recorded session, or none without the shared data."""
    folder = os.environ.get("CTR_NLP_SHARED_DATA")
    path = Path(folder or "") / "grblhal_transcript.txt"
    if not folder or not path.exists():
        return []
    groups = []
    for line in path.read_text().splitlines():
        if line.startswith("### "):
            groups.append((line[4:], []))
        elif match := RECORDED.match(line):
            groups[-1][1].append((float(match[1]), match[2], match[3]))
    return groups


BUTTON = {"e": "estop", "r": "reset", "x": "limit_x", "y": "limit_y", "z": "limit_z"}
RESETS = {"soft reset 0x18 in motion -> ALARM:3": "alarm", "e-stop pin": "banner"}
"""How the recorded reset in motion ended, where not in the usual way."""
RACES = ("hard limit pin",)
"""Here the recorded firmware lost its ALARM:1 in a race that later runs of it did not show."""
AFTER_RACE = ("feed hold, wait Hold:0", "soft limits without homing")
"""What was left of the plan after an unlocked ALARM:3 moved less than it should have, up to the next G0."""


def replay(groups):
    """What the firmware says to a recorded session, sent at the recorded moments.

    Of each group (title, recorded, said, [(recorded, said) status report]), a report beside the latest of ours.
    Where the record's clock starts again, 2 s had passed, as positions in motion before and after show.
    """
    firmware, pushed, before, status = Firmware({1: 25, 11: 0.01}), set(), 0.0, ""
    for title, events in groups:
        firmware.on_reset = RESETS.get(title, "both")
        said, recorded, reports = b"", [], []
        homing = title.startswith("homing $H")
        for when, mark, text in events:
            if not (homing and firmware.state == "Idle"):
                firmware.advance(when - before if before <= when else 2.0 + when)
            before = when
            if mark == ">>":
                firmware.receive(eval(text))
            elif mark == "==" and not homing:
                name = BUTTON[text.split()[-1]]
                (firmware.release if name in pushed else firmware.press)(name)
                pushed ^= {name}
            heard = firmware.take()
            said += heard
            status = ([line for line in heard.decode().split() if line.startswith("<")] or [status])[-1]
            if mark == "<<":
                recorded.append(text)
                if text.startswith("<"):
                    reports.append((text, status))
        firmware.advance(0.0005)
        said += firmware.take()
        yield title, recorded, said.decode().replace("\r", "").split("\n")[:-1], reports


def position(report):
    return np.array([float(v) for v in re.search(r"MPos:([^|>]*)", report)[1].split(",")])


@pytest.fixture(scope="module")
def replayed():
    groups = recorded_groups()
    if not groups:
        pytest.skip("CTR_NLP_SHARED_DATA does not hold grblhal_transcript.txt")
    return list(replay(groups))


def test_the_recorded_session_is_answered_alike(replayed):
    """Every answer but status reports, in order, group by group."""
    for title, recorded, said, _ in replayed:
        if title in RACES:
            continue
        plain = [line for line in recorded if not line.startswith("<")]
        assert [line for line in said if not line.startswith("<")] == plain, title


def test_recorded_positions_are_met(replayed):
    """At rest within a tick's travel of where it came to rest, in motion within three ticks' at the group's speed.

    A byte took effect up to one tick after it was written, the answer came up to one later, and motion began
    up to one after its line.
    """
    compared = 0
    for title, _, _, reports in replayed:
        for theirs, ours in reports:
            if title.startswith(("homing $H", *AFTER_RACE)):
                continue
            speed = 600.0 if "rotary" in title else 40.0
            away = np.abs(position(theirs) - position(ours)).max()
            assert away <= 3 * TICK_S * speed, (title, theirs, ours)
            compared += 1
    assert compared > 100


def test_recorded_reports_are_met(replayed):
    """State, free blocks to one, and which fields are shown: of all reports at most one in twenty differs."""
    differing, total = [], 0
    for title, _, _, reports in replayed:
        for theirs, ours in reports:
            fields = [[part.split(":")[0] for part in report.strip("<>").split("|")] for report in (theirs, ours)]
            total += 1
            if fields[0] != fields[1]:
                differing.append((title, theirs, ours))
    assert len(differing) <= total / 20, differing


def test_reports_have_the_recorded_fields():
    """A report of each kind of the session, word for word: first, second, running, tenth."""
    host = Host()
    first, second = host.ask(b"?", b"?")
    still = "<Idle|MPos:0.000,0.000,0.000,0.000,0.000,0.000|Bf:100,1023|FS:0,0"
    assert first == still + "|Ov:100,100,100|A:|TLR:0>"
    assert second == still + "|WCO:0.000,0.000,0.000,0.000,0.000,0.000>"
    host.ask("G93", "N17 G1 X-1 F60")
    (report,) = host.ask(b"?")
    assert re.fullmatch(r"<Run\|MPos:-0\.\d+,.*\|Bf:99,1023\|Ln:17\|FS:60,0>", report)


@pytest.mark.parametrize(
    ("lines", "answers"),
    [
        (["G1 X", "G90", "", "G90"], ["error:2", "error:2", "ok", "ok"]),
        (["G999", "", "FOO", ""], ["error:20", "ok", "error:2", "ok"]),
        (["G1 X5 X6", "", "G1 Q5"], ["error:25", "ok", "error:36"]),
        (["G93", "G1 X-11", "", "G1 X-11 F60", "X-12"], ["ok", "error:22", "ok", "ok", "error:22"]),
        (["G90 G91", "", "G1 G0 X0", "", "G94 G93"], ["error:21", "ok", "error:24", "ok", "error:21"]),
        (["N99999999 G1 X0 F60", "", "N-1 G1 X0"], ["error:27", "ok", "error:4"]),
        (["$20=1", "$22=1", "$20=1"], ["error:10", "ok", "ok"]),
        (["?"], None),
    ],
)
def test_answers(lines, answers):
    heard = Host().ask(*lines)
    if answers is None:
        assert heard[0].startswith("<Idle")
        answers, heard = ["ok"], heard[1:]
    assert heard == answers


def test_ok_means_planned_and_a_full_planner_gives_none():
    """A hundred blocks and what was executed are answered; the next answer comes when a block is done with."""
    host = Host()
    host.ask("G93")
    heard = [line for text in program(BLOCKS, seconds=1.0) for line in host.ask(text, seconds=0.003)]
    heard += host.listen(0.1)
    assert heard == ["ok"] * BLOCKS
    assert host.firmware.motion.free < BLOCKS
    room = host.firmware.motion.free
    heard = host.ask(*program(BLOCKS + room + 5, seconds=1.0)[BLOCKS:], seconds=0.003)
    heard += host.listen(0.1)
    assert heard.count("ok") == room
    heard = host.listen(2.0)
    assert heard.count("ok") == 2
    (report,) = host.ask(b"?")
    assert "|Bf:0," in report


def test_bytes_beyond_the_receive_buffer_are_lost():
    firmware = Firmware()
    firmware.receive(b"G93\n" + "\n".join(program(200, seconds=1.0)).encode() + b"\n")
    firmware.advance(0.01)
    assert firmware.bytes_lost > 0
    assert firmware.take().count(b"ok") == 1 + BLOCKS
    firmware.advance(300)
    numbers = [number for number, _ in firmware.executed_blocks]
    assert len(numbers) < 200


@pytest.mark.parametrize("seconds", [0.05, 0.1])
def test_a_steady_program_takes_its_time(seconds):
    """Look-ahead carries speed through all lines: only one ramp up and one down are added to count * seconds."""
    host = Host()
    host.ask("G93", *program(40, seconds), seconds=0.01)
    start = host.clock.now() - 0.4
    host.settle()
    speed = 0.2 / seconds
    ramp = max(speed / 200, 2 / seconds / 2000)
    assert 40 * seconds - 0.1 <= host.clock.now() - start <= 40 * seconds + ramp + 0.15
    assert [number for number, _ in host.firmware.executed_blocks] == list(range(1, 41))


def test_a_lone_line_is_a_trapezoid():
    """Closed form: 10 mm at 20 mm/s with 200 mm/s^2 take 10/20 + 20/200 = 0.6 s."""
    firmware = Firmware()
    firmware.receive(b"G1 X-10 F1200\n")
    firmware.advance(0.3)
    assert firmware.position[0] == pytest.approx(-5, abs=0.0026)
    firmware.advance(0.299)
    assert firmware.state == "Run"
    firmware.advance(0.002)
    assert firmware.state == "Idle"
    assert firmware.position[0] == -10


def test_no_axis_beats_its_limits():
    """Random corners: between any two moments no axis is faster than its rate, nor harder accelerated."""
    draw = np.random.default_rng(1)
    firmware = Firmware()
    firmware.settings[11] = 0.0
    for _ in range(30):
        words = [
            f"{a}{v:.3f}" for a, v in zip("XYZABC", draw.uniform(-1, 1, 6) * [9, 9, 9, 99, 99, 99], strict=True)
        ]
        firmware.receive(("G1 " + " ".join(words) + " F90000\n").encode())
    track = []
    while firmware.state == "Run":
        firmware.advance(0.01)
        track.append(firmware.motion.position)
    speed = np.abs(np.diff(track, axis=0)).max(axis=0) / 0.01
    assert (speed <= np.array(firmware.settings.limits().speed) * 1.001).all()
    assert (speed > np.array(firmware.settings.limits().speed) * 0.2).all()


def test_twenty_seconds_cost_little():
    firmware = Firmware()
    firmware.receive(b"G93\n")
    began = time.process_time()
    for text in program(400, 0.05, -0.05):
        firmware.receive(text.encode() + b"\n")
        firmware.advance(0.05)
    firmware.advance(5)
    assert len(firmware.executed_blocks) == 400
    assert time.process_time() - began < 1.0


def test_hold_stops_on_the_path_and_resume_finishes():
    host = Host()
    host.ask("G94", "G1 X-30 Y-15 F1200", seconds=0.3)
    host.ask(b"!", seconds=0.02)
    (report,) = host.ask(b"?", seconds=0.01)
    assert report.startswith("<Hold:1")
    host.listen(0.5)
    (report,) = host.ask(b"?")
    assert report.startswith("<Hold:0")
    held = host.firmware.position
    assert held[1] == pytest.approx(held[0] / 2, abs=0.003)
    assert host.ask("G1 X0", seconds=0.3) == []
    assert (host.firmware.position == held).all()
    assert host.ask(b"~") == ["[MSG:]", "ok"]
    host.settle()
    assert host.firmware.executed_blocks[0][1][:2] == (-30, -15)
    assert host.firmware.position[0] == 0


@pytest.mark.parametrize("ending", ["both", "alarm", "banner"])
def test_reset_in_motion_ends_in_one_of_three_ways(ending):
    host = Host()
    host.firmware.on_reset = ending
    host.ask("G1 X-30 F600", seconds=0.5)
    heard = host.ask(b"\x18", seconds=0.3)
    stopped = host.firmware.position
    assert -30 < stopped[0] < 0
    assert ("ALARM:3" in heard) == (ending != "banner")
    assert any("GrblHAL" in line for line in heard) == (ending != "alarm")
    if ending != "banner":
        assert host.ask("G0 X0") == ["error:9"]
        assert host.ask("$X") == ["[MSG:Caution: Unlocked]", "ok"]
    host.listen(4)
    assert host.firmware.position[0] == (-30 if ending == "alarm" else stopped[0])


def test_reset_in_hold_keeps_the_position_without_alarm():
    host = Host()
    host.ask("G1 X-30 F600", seconds=0.5)
    host.ask(b"!", seconds=0.5)
    held = host.firmware.position
    heard = host.ask(b"\x18", seconds=0.3)
    assert not any("ALARM" in line for line in heard)
    assert host.firmware.state == "Idle"
    host.listen(1)
    assert (host.firmware.position == held).all()


def test_homing_ends_at_the_pull_off_and_arms_soft_limits():
    host = Host()
    host.ask("$22=1", "$27=1", "$20=1", "G1 X5 F3000", seconds=0.01)
    host.settle()
    host.ask("$H", seconds=0.01)
    began = host.clock.now()
    while host.firmware.state == "Home":
        host.listen(0.05)
        assert host.clock.now() < began + 60
    assert host.clock.now() - began > 1
    assert host.firmware.position[:3] == pytest.approx([-1, -1, -1])
    host.listen(0.2)
    assert host.ask("G1 A1000 F36000") == ["ok"]
    host.settle()
    assert host.ask("$J=G90 X5 F600", "") == ["error:15", "ok"]
    assert host.ask("G1 X-151 F600", seconds=0.2) == ["ALARM:2", "[MSG:Reset to continue]"]
    assert host.ask("$X", "G1 X-2") == ["error:79", "error:9"]
    host.ask(b"\x18")
    assert host.ask("$X") == ["[MSG:Caution: Unlocked]", "ok"]
    assert host.firmware.position[0] == -1


def test_soft_limit_in_motion_brakes_first():
    host = Host(homed=True, settings={20: 1})
    host.ask("G1 X-60 F600", seconds=0.5)
    here = host.firmware.position[0]
    heard = host.ask("G1 X20", seconds=0.5)
    assert heard == ["ALARM:2", "[MSG:Reset to continue]"]
    assert here - 2 < host.firmware.position[0] < here - 0.25


def test_check_mode_moves_nothing():
    host = Host()
    assert host.ask("$C", "G93 G1 X-40 F60", "G1 X1") == ["[MSG:Enabled]", "ok", "ok", "error:22"]
    host.listen(1)
    assert host.firmware.position[0] == 0
    assert host.ask("$C")[-1].startswith("GrblHAL")


def test_motion_goes_on_without_a_link_and_a_reconnect_gives_no_banner():
    host = Host()
    host.ask("G1 X-30 F600", seconds=0.5)
    old = host.wire
    old.close()
    with pytest.raises(ConnectionError):
        old.read(0.1)
    host.clock.sleep(1.0)
    assert host.firmware.position[0] == pytest.approx(-14.7, abs=0.3)
    host.wire = Wire(host.firmware, host.clock)
    assert host.listen(0.2) == []
    (report,) = host.ask(b"?")
    assert report.startswith("<Run")


def test_a_second_wire_ends_the_first():
    host = Host()
    Wire(host.firmware, host.clock)
    with pytest.raises(ConnectionError):
        host.wire.write(b"?")


def faulty(name, **options):
    host = Host(fault(name, at=0.5, **options))
    host.ask("G93", *program(30), seconds=0.01)
    return host


def test_cut():
    host = faulty("cut")
    with pytest.raises(ConnectionError):
        host.listen(1)
    host.clock.sleep(4)
    assert len(host.firmware.executed_blocks) == 30


def test_half_open():
    host = faulty("half_open")
    host.listen(0.5)
    assert host.ask("G90") == []
    assert len(host.ask(b"?")) == 1


def test_silent():
    host = faulty("silent")
    host.listen(0.5)
    assert host.ask("G90", b"?") == []
    host.wire = Wire(host.firmware, host.clock)
    assert host.ask(b"?") == []
    host.listen(3)
    assert len(host.firmware.executed_blocks) == 30


def test_busy():
    host = faulty("busy", seconds=2.0)
    host.listen(0.3)
    here = host.firmware.position
    assert host.ask(b"?", seconds=1.5) == []
    assert (host.firmware.position == here).all()
    assert host.listen(1.0)[0].startswith("<Run")
    host.settle()
    assert len(host.firmware.executed_blocks) == 30


@pytest.mark.parametrize(("name", "expected"), [("lost", 0), ("doubled", 40), ("late", 20)])
def test_replies_lost_doubled_late(name, expected):
    host = faulty(name, **({"choice": 1.0} if name != "late" else {}))
    host.listen(0.5)
    heard = host.ask(*["G90"] * 20, seconds=0.01)
    assert len(heard) == (0 if name == "late" else expected)
    assert len(heard + host.listen(1)) == expected


def test_garbled():
    host = faulty("garbled", choice=0.5)
    host.listen(0.5)
    heard = host.ask(*["$G"] * 10, seconds=0.03)
    good = [line for line in heard if line == "ok" or line.startswith("[GC:G1 G54 G17 G21 G90 G93")]
    assert 0 < len(good) < 20


def test_last_ok():
    """Only the ok to what came last is missing."""
    host = Host(fault("last_ok", after_bytes=300))
    host.ask("G93")
    host.wire.write(("\n".join(program(12)) + "\n").encode())
    assert host.listen(1).count("ok") == 11
    host.settle()
    assert len(host.firmware.executed_blocks) == 12


def test_bytes_lost():
    host = faulty("bytes_lost", choice=0.3)
    host.listen(0.5)
    before = host.firmware.bytes_received
    host.ask("G90 G90 G90 G90 G90 G90 G90 G90")
    assert 0 < host.firmware.bytes_received - before < 32


@pytest.mark.parametrize("loses", [0, 1])
def test_banner(loses):
    host = faulty("banner", choice=loses)
    heard = host.listen(1)
    assert any(line.startswith("GrblHAL") for line in heard)
    assert host.firmware.state == "Idle"
    assert (host.firmware.position[0] == 0) == bool(loses)
    assert len(host.firmware.executed_blocks) < 30
    lost = host.firmware.slip[0]
    assert (lost < 0) == bool(loses)


@pytest.mark.parametrize(("name", "alarm"), [("hard_limit", 1), ("soft_limit", 2), ("estop", 10)])
def test_alarms(name, alarm):
    host = faulty(name)
    heard = host.listen(1.5)
    assert f"ALARM:{alarm}" in heard
    stopped = host.firmware.position
    assert stopped[0] < 0
    assert host.ask("G1 X0 F60") == ["error:9"]
    host.listen(1)
    assert (host.firmware.position == stopped).all()


def test_estop_with_a_full_planner():
    host = Host(fault("estop", at=1.0))
    host.ask("G93")
    for text in program(120, seconds=1.0):
        host.wire.write(text.encode() + b"\n")
    heard = host.listen(1.5)
    assert "ALARM:10" in heard
    done = len(host.firmware.executed_blocks)
    host.listen(3)
    assert len(host.firmware.executed_blocks) == done


def test_error_latch():
    host = faulty("error_latch", choice=20)
    host.listen(0.5)
    assert host.ask("G90", "G90", "", "G90") == ["error:20", "error:20", "ok", "ok"]


def test_faults_come_at_a_byte_count_and_any_two_together():
    host = Host(fault("doubled", after_bytes=8, choice=1.0), fault("late", after_bytes=8, seconds=0.3))
    assert host.ask("G90") == ["ok"]
    assert host.ask("G90", seconds=0.2) == []
    assert host.listen(0.3) == ["ok", "ok"]


@pytest.mark.parametrize("seed", range(12))
def test_random_faults_never_break_the_emulator(seed):
    """Whatever strikes, time passes, positions stay on the path and the link only ever raises ConnectionError."""
    draw = random.Random(seed)
    names = draw.sample(sorted(FAULTS), 3)
    host = Host(*(FAULTS[name](at=draw.uniform(0, 2), seed=seed) for name in names))
    try:
        for line in ["G93", *program(40)]:
            host.ask(line, seconds=0.04)
        host.ask(b"!", b"?", b"~", b"\x18", "$X", seconds=0.2)
    except ConnectionError:
        assert {"cut", "power_cycle_unseen"} & set(names)
    low, high = host.firmware.extremes
    assert (low >= np.array([-8.001, 0, 0, 0, 0, 0])).all()
    assert (high <= np.array([0, 0, 0, 80.001, 0, 0])).all()


def test_unknown_names_are_refused_with_those_that_there_are():
    with pytest.raises(OptionError, match=r"'melt'.*half_open"):
        fault("melt")
    with pytest.raises(OptionError, match=r"'panic'.*estop"):
        Firmware().press("panic")
    with pytest.raises(OptionError, match=r"'usb'.*tcp, pty"), serving(Firmware(), "usb"):
        pass


def wait_for(connection, wanted, seconds=3.0):
    end, data = time.monotonic() + seconds, b""
    while wanted not in data:
        assert time.monotonic() < end, data
        data += connection.read(connection.in_waiting or 1)
    return data


@pytest.mark.parametrize("kind", ["tcp", "pty"])
def test_served_to_pyserial(kind):
    """Over either port: a move is answered and made, and goes on while nobody is connected."""
    serial = pytest.importorskip("serial")
    if kind == "pty" and not hasattr(os, "openpty"):
        pytest.skip("no pseudo-terminals here")
    firmware = Firmware()
    with serving(firmware, kind) as url:
        with serial.serial_for_url(url, baudrate=115200, timeout=0.05) as connection:
            connection.write(b"G94\nG1 X-20 F600\n")
            wait_for(connection, b"ok\r\nok\r\n")
            connection.write(b"?")
            assert b"<Run" in wait_for(connection, b">")
        gone = firmware.position[0]
        time.sleep(0.5)
        with serial.serial_for_url(url, baudrate=115200, timeout=0.05) as connection:
            connection.write(b"?")
            assert b"Grbl" not in wait_for(connection, b">")
            assert -20 < firmware.position[0] < gone - 3


def test_a_cut_reaches_a_served_host():
    serial = pytest.importorskip("serial")
    with (
        serving(Firmware(), "tcp", faults=(fault("cut", after_bytes=4),)) as url,
        serial.serial_for_url(url, timeout=2) as connection,
    ):
        connection.write(b"G90\n")
        with pytest.raises(serial.SerialException):
            connection.read(10)


def test_program_prints_its_url_and_ends_on_sigterm():
    command = [sys.executable, "-m", "emulator", "--tcp", "0", "--homed", "--settings", "$20=1"]
    tests = Path(__file__).parents[1]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=tests) as process:
        assert re.fullmatch(r"socket://127\.0\.0\.1:\d+\n", process.stdout.readline())
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=10) == 0


def test_a_page_in_a_browser_cannot_send_commands():
    firmware = Firmware()
    request = b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: 16\r\n\r\nG1 X-1 A1 F600\r\n"
    with serving(firmware) as url:
        host, _, port = url.removeprefix("socket://").partition(":")
        with socket.create_connection((host, int(port)), 10) as link:
            link.sendall(request)
            heard = b""
            with contextlib.suppress(ConnectionResetError):
                while data := link.recv(4096):
                    heard += data
    assert b"ok" not in heard
    assert b"error" not in heard
    assert firmware.state != "Run"
