"""Faults that deceive: third parties, text that lies, flipped bits, motors gone limp and power that has failed."""

import re

import numpy as np
import pytest
from emulated import Host, program
from emulator import Wire, fault
from emulator.faults import LIES


def playing(name, **options):
    """A host with thirty lines of 0.1 s on their way and a fault at 0.5 s."""
    host = Host(fault(name, at=0.5, **options))
    host.ask("G93", *program(30), seconds=0.01)
    host.listen(0.15)
    return host


def reported(line):
    return np.array([float(value) for value in re.search(r"MPos:([^|]*)", line)[1].split(",")])


@pytest.mark.parametrize(
    ("data", "state"), [(b"!", "Hold"), (b"\x18", "Alarm"), (b"\x19", "Idle"), (b"\x91", "Run"), (b"~", "Run")]
)
def test_a_third_party_does_what_it_likes_to_the_motion(data, state):
    host = playing("third_party", data=data)
    host.listen(0.6)
    assert host.firmware.state == state


@pytest.mark.parametrize(
    ("data", "answer"), [(b"$J=G91 X1 F600\n", "error:8"), (b"$1=25\n", "error:8"), (b"G94\n", "ok")]
)
def test_a_third_party_is_answered_on_our_stream(data, answer):
    assert playing("third_party", data=data).listen(0.3) == [answer]


def test_a_third_party_writes_settings_and_jogs_where_nothing_runs():
    host = Host(
        fault("third_party", at=0.1, data=b"$1=25\n"), fault("third_party", at=0.2, data=b"$J=G91X-1F600\n")
    )
    assert host.listen(1.0) == ["ok", "ok"]
    assert host.firmware.settings[1] == 25
    assert host.firmware.position[0] == -1


def test_third_parties_are_drawn_where_none_is_named():
    """Whoever is drawn, something is received that our host did not send."""
    for seed in range(20):
        host = Host(fault("third_party", at=0.1, seed=seed))
        host.listen(0.3)
        assert host.firmware.bytes_received > 0


@pytest.mark.parametrize("name", sorted(LIES))
@pytest.mark.parametrize("begun", ["idle", "running", "held", "connecting"])
def test_a_lie_is_one_whole_line_and_changes_nothing(name, begun):
    struck = Host(fault(name, **({"after_bytes": 1} if begun == "connecting" else {"at": 0.5})))
    honest = Host()
    heard = []
    for host in (struck, honest):
        lines = host.ask("$G") if begun == "connecting" else host.ask("G93")
        if begun in ("running", "held"):
            lines += host.ask(*program(30), seconds=0.01)
        if begun == "held":
            lines += host.ask(b"!")
        heard.append(lines + host.listen(0.5) + host.ask(b"?"))
    said, true = heard
    lie = [line for line in said if line not in true] or ["ok"]
    assert len(said) == len(true) + (2 if name == "false_banner" else 1)
    assert len([line for line in lie if line]) == 1
    assert struck.firmware.state == honest.firmware.state
    assert (struck.firmware.position == honest.firmware.position).all()


@pytest.mark.parametrize(("name", "ahead"), [("false_past", -1), ("false_future", 1)])
def test_a_report_of_another_moment_is_far_from_where_it_is(name, ahead):
    host = playing(name)
    (line,) = [line for line in host.listen(0.3) if line.startswith("<Idle")]
    here = -host.firmware.position[0]
    assert (-reported(line)[0] - here) * ahead > 0.05


def test_a_report_of_another_state_tells_the_true_position():
    host = playing("false_state")
    (line,) = [line for line in host.listen(0.3) if line.startswith("<")]
    assert not line.startswith("<Run")
    assert reported(line)[0] == pytest.approx(host.firmware.position[0], abs=0.7)


def test_a_lie_may_be_said_word_for_word():
    assert playing("noise", data=b"[MSG:Caution: Unlocked]").listen(0.3) == ["[MSG:Caution: Unlocked]"]


def test_flipped_bits_reach_the_host():
    """The share of bytes is kept, and each has exactly one bit inverted."""
    host = Host(fault("flips_to_host", at=0.0, choice=0.1))
    host.wire.write(b"$$\n")
    host.clock.sleep(1.0)
    struck = host.wire.read(0.0)
    honest = Host()
    honest.wire.write(b"$$\n")
    honest.clock.sleep(1.0)
    true = honest.wire.read(0.0)
    changed = [a ^ b for a, b in zip(struck, true, strict=True) if a != b]
    assert 0.07 < len(changed) / len(true) < 0.13
    assert {value.bit_count() for value in changed} == {1}


def test_flipped_bits_reach_the_controller():
    host = Host(fault("flips_to_device", at=0.0, choice=0.05))
    heard = [line for _ in range(60) for line in host.ask("G90", seconds=0.01)]
    assert any(line != "ok" for line in heard)


def test_power_that_fails_is_seen_or_not():
    """Counts begin at zero while the mechanics stay; nobody sees a banner where the link is cut."""
    seen, unseen = playing("power_cycle"), playing("power_cycle_unseen")
    assert any(line.startswith("GrblHAL") for line in seen.listen(0.3))
    with pytest.raises(ConnectionError):
        unseen.listen(0.3)
    unseen.wire = Wire(unseen.firmware, unseen.clock)
    assert [line for line in unseen.ask(b"?", seconds=0.3) if not line.startswith("<Idle|MPos:0.000")] == []
    for host in (seen, unseen):
        assert (host.firmware.position == 0).all()
        assert host.firmware.slip[0] < -0.5
        assert len(host.firmware.executed_blocks) < 30


@pytest.mark.parametrize(
    ("settings", "limp"),
    [({1: 25}, "XYZABC"), ({1: 0}, "XYZABC"), ({1: 25, 37: 7}, "ABC"), ({1: 254, 37: 63}, ""), ({}, "")],
)
@pytest.mark.parametrize("held", [False, True])
def test_motors_go_limp_when_they_stand_still(settings, limp, held):
    """They do it once each time that motion ends, in a hold as well, and the firmware reports nothing of it."""
    host = Host(settings=settings)
    host.ask("G1 X-20 F1200", seconds=0.3)
    if held:
        host.ask(b"!", seconds=1.0)
        host.ask(b"~", seconds=0.01)
    else:
        host.settle()
        host.listen(1.0)
        host.ask("G1 X-30 F1200", seconds=0.01)
    away = host.firmware.slip.copy()
    assert "".join(letter for letter, slip in zip("XYZABC", away, strict=True) if slip) == limp
    host.settle()
    assert host.firmware.position[0] == (-20 if held else -30)
    host.listen(1.0)
    np.testing.assert_allclose(host.firmware.slip, 2 * away)
