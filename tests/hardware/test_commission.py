"""Commissioning, as a person does it: on the emulated controller in real time, over TCP, with lines typed."""

from __future__ import annotations

import io
import json
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from bench import sweep
from emulator import Firmware, serving

from ctr_nlp.cli.commands.commission import main as commission
from ctr_nlp.cli.commands.play import main
from ctr_nlp.exceptions import HardwareError
from ctr_nlp.hardware.description import Hardware, commissioned_file, read_commissioned

pytestmark = pytest.mark.real_time

AXIS = '[[axes]]\njoint = "{}"\nletter = "{}"\nunit = "{}"\nrange = {}\nspeed = {}\nacceleration = {}\n'


class Rig:
    """A controller that is served, and its hardware file."""

    def __init__(self, url: str, firmware: Firmware, folder: Path, name: str = "rig.toml") -> None:
        self.firmware, self.folder, self.file = firmware, folder, folder / name
        axes = [AXIS.format(f"beta_{i + 1}", "XYZ"[i], "mm", "[0, 150]", 50.0, 200.0) for i in range(3)]
        axes += [AXIS.format(f"alpha_{i + 1}", "ABC"[i], "deg", "[-360, 360]", 600.0, 2000.0) for i in range(3)]
        self.file.write_text(f'[connection]\ndevice = "grbl"\nurl = "{url}"\n' + "".join(axes))

    def commission(self, typed: str, monkeypatch: pytest.MonkeyPatch) -> int:
        """The exit status."""
        monkeypatch.setattr("sys.stdin", io.StringIO(typed))
        return main(["--commission", "--hardware", str(self.file), "--out", str(self.folder / "out")])

    def play(self) -> int:
        """The exit status."""
        sweep(12).save(self.folder / "plan.npz")
        arguments = [
            "--hardware",
            str(self.file),
            "--out",
            str(self.folder / "play"),
            "--uncertified",
            "--position-verified",
        ]
        return main([str(self.folder / "plan.npz"), *arguments])


def unwrapped(capsys: pytest.CaptureFixture[str]) -> str:
    """What was told on stdout, on one line."""
    return " ".join(capsys.readouterr().out.split())


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    firmware = Firmware()
    with serving(firmware, "tcp") as url:
        yield Rig(url, firmware, tmp_path)


ALL = "".join(f"{letter}+\n{letter}-\n" for letter in "XYZABC")
NONE = "".join(f"skip {letter}\n" for letter in "XYZABC")


def test_axes_move_as_asked(rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert rig.commission("z+\nA-\nQ+\nY-\nskip Q\n\nX+\n", monkeypatch) == 1
    out = capsys.readouterr().out
    assert "Z went from 0.000 to 1.000" in out
    assert "A went from 0.000 to -1.000" in out
    assert "'Q+' is no command" in out
    assert "'SKIP Q' is no command" in out
    assert "axis Y (beta_2) stands at 0 mm and would go to -1; it must stay in [0, 150]" in out
    assert rig.firmware.position.tolist() == [0.0, 0.0, 1.0, -1.0, 0.0, 0.0]


def test_settings_are_kept_once_every_axis_moved_both_ways(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    some = "".join(line + "\n" for line in ALL.split() if line not in ("Y-", "B+"))
    assert rig.commission(some, monkeypatch) == 1
    assert "Nothing was kept, since these steps have not been made: Y- B+" in unwrapped(capsys)
    assert not commissioned_file(rig.file).exists()
    assert rig.commission(some + "y-\ny-\nb+\n", monkeypatch) == 0
    assert json.loads(commissioned_file(rig.file).read_text())["untried"] == []
    capsys.readouterr()
    assert rig.play() == 0
    assert "tried" not in capsys.readouterr().err


def test_a_hardware_file_of_any_name_is_commissioned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    firmware = Firmware()
    with serving(firmware, "tcp") as url:
        rig = Rig(url, firmware, tmp_path, "rig [left] [red]\x1b[2J\n'a\"b $x$ (G28) \u202e.toml")
        assert rig.commission(ALL, monkeypatch) == 0
        assert rig.play() == 0
    told = capsys.readouterr()
    assert "Traceback" not in told.err
    assert all(line.isprintable() for line in (told.out + told.err).splitlines())
    assert read_commissioned(rig.file) is not None


def test_a_rig_that_was_never_commissioned_is_noted(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    assert rig.play() == 0
    assert "note: this rig was never commissioned" in capsys.readouterr().err


def test_axes_that_are_skipped_are_recorded_and_noted(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig.commission("X+\nX-\nZ+\nskip z\nskip Y\nskip A\nskip B\nskip C\n", monkeypatch) == 0
    assert "Kept without a trial of axes Y, Z, A, B, C" in unwrapped(capsys)
    assert json.loads(commissioned_file(rig.file).read_text())["untried"] == list("YZABC")
    assert rig.play() == 0
    assert "note: when the rig was commissioned, axes were not tried: Y, Z, A, B, C" in capsys.readouterr().err


def test_a_record_of_before_does_not_tell_which_axes_were_tried(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig.commission(NONE, monkeypatch) == 0
    kept = json.loads(commissioned_file(rig.file).read_text())
    del kept["untried"]
    commissioned_file(rig.file).write_text(json.dumps(kept))
    assert rig.play() == 0
    assert "commissioning does not say which axes were tried" in capsys.readouterr().err


def test_a_folder_that_is_named_like_a_file_is_refused(rig: Rig, capsys: pytest.CaptureFixture[str]) -> None:
    out = rig.folder / "kept.json"
    assert commission([str(rig.file), "--out", str(out)]) == 2
    said = capsys.readouterr().err
    assert said == f"error: --out is {out}, but journal.jsonl and more go into a folder; name a folder\n"
    assert not out.exists()


@pytest.mark.parametrize(("value", "wanted"), [(0.01, "0.1"), (3.0, "1")])
def test_a_junction_deviation_out_of_range_is_wrong_wherever_it_is_read(
    value: float, wanted: str, rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.firmware.settings[11] = value
    assert rig.commission(NONE, monkeypatch) == 1
    assert f"$11={wanted}" in capsys.readouterr().out
    assert rig.play() == 1
    assert f"set $11={wanted}" in capsys.readouterr().err
    rig.firmware.settings[11] = float(wanted)
    assert rig.commission(NONE, monkeypatch) == 0
    assert rig.play() == 0


def test_a_junction_deviation_that_was_kept_by_other_rules_is_not_asked_for_again(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig.commission(NONE, monkeypatch) == 0
    kept = json.loads(commissioned_file(rig.file).read_text())
    kept["settings"]["11"] = "0.010"
    commissioned_file(rig.file).write_text(json.dumps(kept))
    assert rig.play() == 0
    rig.firmware.settings[11] = 0.01
    assert rig.play() == 1
    assert "set $11=0.1" in capsys.readouterr().err


def test_settings_that_were_kept_are_compared(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert rig.commission(NONE, monkeypatch) == 0
    known = json.loads(commissioned_file(rig.file).read_text())
    assert known["settings"]["110"] == "3000.000"
    assert "grblHAL" in known["controller"]
    assert rig.play() == 0
    capsys.readouterr()
    rig.firmware.settings[3] = 1
    assert rig.play() == 1
    said = capsys.readouterr().err
    assert "the controller's $3 is 1, and was 0 when the rig was commissioned: set $3=0" in said
    assert rig.commission(NONE, monkeypatch) == 0
    assert "settings that have changed since the rig was commissioned" in capsys.readouterr().out
    assert rig.play() == 0


def test_settings_that_are_wrong_are_explained_and_nothing_is_moved_or_kept(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.firmware.settings.update({1: 25, 13: 1, 122: 100.0})
    assert rig.commission("X+\n", monkeypatch) == 1
    out = capsys.readouterr().out
    for text in ("$1=255", "go limp after 25 ms", "$13=0", "$122=200", "Nothing was moved or kept"):
        assert text in out
    assert rig.firmware.executed_blocks == []
    assert not commissioned_file(rig.file).exists()


def test_what_is_looser_than_plans_need_is_named_and_set(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A line that was changed on the way then goes no faster than a plan may."""
    rig.firmware.settings[112] = 6000.0
    assert rig.commission(NONE, monkeypatch) == 0
    assert "$112=3000" in capsys.readouterr().out
    assert rig.firmware.settings[112] == 6000.0
    assert rig.play() == 0
    said = capsys.readouterr().err
    assert "note: the controller's $112 is 6000.000, and lets a corrupted line move Z" in said
    assert rig.commission("set\nset\n" + NONE, monkeypatch) == 0
    out = capsys.readouterr().out
    assert "written to the controller: $112=3000" in out
    assert "No setting is looser than it need be" in out
    assert rig.firmware.settings[112] == 3000.0
    assert json.loads(commissioned_file(rig.file).read_text())["settings"]["112"] == "3000.000"
    assert rig.play() == 0
    assert "$112" not in capsys.readouterr().err


def test_a_controller_in_alarm_is_not_commissioned(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.firmware.hard_limit()
    assert rig.commission("X+\n", monkeypatch) == 1
    assert "the controller is Alarm; it must be Idle to be commissioned" in capsys.readouterr().err


def test_only_a_grbl_controller_is_commissioned(
    rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    rig.file.write_text(rig.file.read_text().replace('"grbl"', '"simulated"'))
    assert rig.commission("", monkeypatch) == 2
    assert "device of the connection is 'simulated'" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"settings": []}', "\xff"])
def test_a_record_that_cannot_be_read_is_named(text: str, tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    assert read_commissioned(file) is None
    commissioned_file(file).write_text(text, encoding="latin-1")
    with pytest.raises(HardwareError, match=r"rig.commissioned.json cannot be read .*; delete it"):
        read_commissioned(file)
    with pytest.raises(HardwareError):
        Hardware.from_toml(file)


@pytest.mark.skipif(sys.platform == "win32", reason="signals of Unix")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGQUIT"])
def test_a_signal_stops_a_step(
    name: str, rig: Rig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    number, unheeded = getattr(signal, name), list[int]()

    def send() -> None:
        while not rig.firmware.moving:
            time.sleep(0.005)
        os.kill(os.getpid(), number)

    before = signal.signal(number, lambda *_: unheeded.append(number))
    try:
        thread = threading.Thread(target=send)
        thread.start()
        assert rig.commission("X+\nY+\n", monkeypatch) == 128 + number
        thread.join()
    finally:
        signal.signal(number, before)
    assert not unheeded
    assert 0.0 < rig.firmware.position[0] < 1.0
    assert rig.firmware.position[1] == 0.0
    assert "axis X was stopped before it had made its step" in unwrapped(capsys)
