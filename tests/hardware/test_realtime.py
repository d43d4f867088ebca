"""Characters that act at once, as on real firmware: overrides, and what stops motion in which state."""

import math
import re

import numpy as np
import pytest
from emulated import Host, program
from emulator.planner import Overrides

FASTER, SLOWER, USUAL = b"\x91", b"\x92", b"\x90"


def overrides_told(host):
    """The Ov field of the next report, or None."""
    (report,) = host.ask(b"?")
    found = re.search(r"Ov:([0-9,]*)", report)
    return found and found[1]


def speed_of(host, seconds=0.2):
    """Mean speed of X over some time, mm/s."""
    before = host.firmware.position[0]
    host.listen(seconds)
    return abs(host.firmware.position[0] - before) / seconds


@pytest.mark.parametrize(
    ("bytes_sent", "percent"),
    [
        (FASTER, 110),
        (10 * FASTER, 200),
        (12 * FASTER, 200),
        (9 * SLOWER, 10),
        (12 * SLOWER, 10),
        (b"\x93\x93\x94", 101),
        (5 * FASTER + USUAL, 100),
    ],
)
@pytest.mark.parametrize("timed", [False, True])
def test_a_feed_override_scales_what_runs_and_what_is_planned(bytes_sent, percent, timed):
    """Timed (G93) lines are scaled as others are: sixty lines of 1 mm in 0.1 s, or at F600."""
    host = Host()
    lines = [f"G1 X-{i} F600" for i in range(1, 61)]
    host.ask(*(["G93", *program(60, step=-1.0)] if timed else lines), seconds=0.005)
    host.listen(0.3)
    host.ask(bytes_sent, seconds=0.5)
    assert speed_of(host) == pytest.approx(10 * percent / 100, rel=0.02)


def test_an_override_never_goes_beyond_the_axes_own_rates():
    host = Host()
    host.ask("G1 X-100 F2400", seconds=0.5)
    host.ask(10 * FASTER, seconds=0.3)
    assert speed_of(host) == pytest.approx(50, rel=0.01)


@pytest.mark.parametrize("bytes_sent", [10 * FASTER, 9 * SLOWER])
def test_an_override_keeps_accelerations_and_the_end(bytes_sent):
    """Every 10 ms the speed of X changes by 2 mm/s at most, at 200 mm/s^2, and the end is not passed."""
    host = Host()
    host.ask("G1 X-25 F1200", "X-40", "X-41", seconds=0.005)
    host.listen(0.4)
    host.wire.write(bytes_sent)
    track = []
    while host.firmware.state != "Idle":
        host.listen(0.01)
        track.append(host.firmware.motion.position[0])
    speeds = np.diff(track) / 0.01
    assert np.abs(np.diff(speeds)).max() < 2.2
    assert track[-1] == -41
    assert min(track) == -41


def test_a_rapid_override_slows_rapids_alone_and_a_jog_knows_none():
    host = Host()
    host.ask(b"\x97", 5 * SLOWER)
    host.ask("G0 X-60", seconds=0.5)
    assert speed_of(host) == pytest.approx(50 / 4, rel=0.01)
    host.settle()
    host.ask("$J=G90 X0 F600", seconds=0.3)
    assert speed_of(host) == pytest.approx(10, rel=0.01)


def test_overrides_stand_in_the_very_next_report_and_a_reset_ends_them():
    host = Host()
    host.ask(b"?", b"?", b"?")
    assert overrides_told(host) is None
    host.ask(FASTER, b"\x96", b"\x9a")
    assert overrides_told(host) == "110,50,110"
    assert overrides_told(host) is None
    host.ask(b"\x18", seconds=0.3)
    assert overrides_told(host) == "100,100,100"


def test_speed_of_a_block_is_that_of_the_planner_s_formula():
    """Feeds scale from what the axes allow, not from what was asked; rapids by their own percentage."""
    assert Overrides(feed=50).speed(80.0, 40.0) == 20.0
    assert Overrides(feed=200).speed(30.0, 40.0) == 40.0
    assert Overrides(feed=200, rapid=25).speed(math.inf, 40.0) == 10.0


@pytest.mark.parametrize("resuming", [b"~", b"\x81"])
def test_a_hold_that_has_not_come_to_rest_is_not_resumed(resuming):
    host = Host()
    host.ask("G1 X-60 F1500", seconds=0.5)
    host.ask(b"\x82", seconds=0.02)
    assert host.ask(resuming, seconds=0.5) == []
    assert host.firmware.motion.is_halted
    assert host.ask(resuming) == ["[MSG:]"]
    assert host.firmware.state == "Run"


def test_a_hold_does_nothing_to_a_jog_which_0x85_ends():
    host = Host()
    host.ask("$J=G91 X-60 F1500", seconds=0.5)
    host.ask(b"!", seconds=0.3)
    assert host.firmware.state == "Jog"
    assert speed_of(host) == pytest.approx(25, rel=0.01)
    host.ask(b"\x85", seconds=0.4)
    assert host.firmware.state == "Idle"
    assert host.firmware.position[0] > -45


def test_0x85_drops_unread_lines_in_any_state():
    """Lines that a hold keeps from being read are gone, with their answers; those planned are played."""
    host = Host()
    host.ask("G1 X-10 F1500", seconds=0.2)
    host.ask(b"!", seconds=0.5)
    assert host.ask("X-20", "X-30") == []
    host.ask(b"\x85")
    assert host.ask(b"~") == ["[MSG:]"]
    host.settle()
    assert host.firmware.position[0] == -10


def test_0x19_stops_at_once_and_forgets_the_plan():
    """25 mm/s at 200 mm/s^2: at rest 0.125 s later, 0.09 s before a hold would be."""
    host = Host()
    host.ask("G1 X-40 F1500", "X-80", seconds=0.4)
    here = host.firmware.position[0]
    assert host.ask(b"\x19", seconds=0.15) == ["[MSG:Stop]"]
    assert host.firmware.state == "Idle"
    assert here - host.firmware.position[0] == pytest.approx(25**2 / 400, abs=0.3)
    stopped = host.firmware.position[0]
    assert host.ask("G91 G1 X-1 F600") == ["ok"]
    host.settle()
    assert host.firmware.position[0] == pytest.approx(stopped - 1, abs=0.003)


def test_0x19_ends_an_alarm_and_the_check_mode():
    """Which a stop must not: it is no way to stop a controller in a state that is not known."""
    host = Host()
    host.ask("G1 X-40 F1500", seconds=0.4)
    host.ask(b"\x18", seconds=0.3)
    assert host.ask("G1 X0") == ["error:9"]
    assert host.ask(b"\x19") == ["[MSG:Stop]"]
    assert host.firmware.state == "Idle"
    host.ask("$C", b"\x19")
    assert host.firmware.state == "Idle"


@pytest.mark.parametrize("byte", [b"!", b"~", b"\x19", b"\x85", FASTER])
def test_homing_is_stopped_by_a_reset_alone(byte):
    host = Host(settings={22: 1})
    host.ask("$H", seconds=0.5)
    host.ask(byte, seconds=0.1)
    assert host.firmware.state == "Home"
    assert "ALARM:6" in host.ask(b"\x18", seconds=0.3)


@pytest.mark.parametrize("byte", [b"\x00", b"\x07", b"\x7f", b"\xa5", b"\xff"])
def test_characters_without_a_meaning_are_dropped(byte):
    assert Host().ask(b"G9" + byte + b"0\n") == ["ok"]


def test_the_reported_line_is_the_one_in_preparation():
    """Some 0.09 s ahead of motion, in lines of 2 mm and 0.1 s; at the end the one that was read last."""
    host = Host()
    host.ask("G93", *program(20, step=-2.0), seconds=0.005)
    host.listen(0.4)
    for _ in range(10):
        (report,) = host.ask(b"?", seconds=0.013)
        line, moved = int(re.search(r"Ln:(\d+)", report)[1]), -float(re.search(r"MPos:([^,]*)", report)[1])
        assert 0.85 < line - moved / 2 < 1.95
    host.settle()
    (report,) = host.ask(b"?")
    assert "|Ln:20|" in report
