"""The command `ctr-nlp play` as a user runs it: in real time, on simulated and emulated devices, interrupted."""

from __future__ import annotations

import csv
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bench import homing_hardware, sweep
from emulator.firmware import Firmware
from emulator.serve import serving

from ctr_nlp import Plan, table_i_robot
from ctr_nlp.cli.commands import play as play_command
from ctr_nlp.cli.commands.play import JOURNAL
from ctr_nlp.cli.commands.play import main as play
from ctr_nlp.cli.operator_control import OPERATOR_KEYS
from ctr_nlp.cli.output.folder import check_folder, output_folder
from ctr_nlp.cli.output.manifest import MARK
from ctr_nlp.hardware import journal as journal_module
from ctr_nlp.hardware.description import Hardware, simulated_hardware
from ctr_nlp.hardware.journal import read_journal
from ctr_nlp.hardware.playing import trust as trust_module
from ctr_nlp.hardware.playing.session import prepare_trajectory
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS
from ctr_nlp.plan.verdicts import NO, YES, Verdict

pytestmark = pytest.mark.real_time

PLAN = sweep(10)
"""Nobody has checked its stability, a wall or samples: where a test is about something else, it is waived."""
ANYWAY = "--uncertified"
LOOKED = "--position-verified"
"""Nothing is remembered of a controller that has just been made: somebody has to look where its axes stand."""
unix = pytest.mark.skipif(sys.platform == "win32", reason="signals of Unix")


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    PLAN.save(tmp_path / "plan.npz")
    return tmp_path / "plan.npz"


@pytest.fixture(autouse=True)
def no_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is typed: the thread that would read it ends."""
    monkeypatch.setattr(sys, "stdin", None)


def toml(hardware: Hardware, path: Path) -> Path:
    """The file of a hardware without arm."""
    lines = [f"approach = {hardware.approach}", "[connection]"]
    connection = vars(hardware.connection)
    lines += [f"{name} = {str(value) if name == 'baud' else repr(value)}" for name, value in connection.items()]
    for axis in hardware.axes:
        lines.append("[[axes]]")
        for name, value in vars(axis).items():
            lines.append(f"{name} = {list(value) if isinstance(value, tuple) else repr(value)}")
    path.write_text("\n".join(lines) + "\n")
    return path


PATIENCE = 120
"""Seconds that a program in a process of its own may take to begin, to move and to end, on a machine at work."""


def main(arguments: list[str]) -> int:
    """The exit status of `ctr-nlp play`, whatever the verdicts on the plan are."""
    return play([*arguments, ANYWAY])


def complaint_of(capsys: pytest.CaptureFixture[str]) -> str:
    """What stderr told, without what is told of every plan, and without notes on verdicts."""
    lines = capsys.readouterr().err.splitlines()
    return "\n".join(line for line in lines if line != NOT_FOR_PATIENTS and not line.startswith("note: "))


def rig(tmp_path: Path, url: str) -> Path:
    hardware = homing_hardware()
    return toml(replace(hardware, connection=replace(hardware.connection, url=url)), tmp_path / "rig.toml")


@contextmanager
def playing(*arguments: Any) -> Iterator[subprocess.Popen[str]]:
    """The program in a process of its own."""
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "ctr_nlp", "play", *map(str, arguments), ANYWAY],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def ended(process: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Exit status and what was said. Standard input stays open, as a terminal does."""
    status = process.wait(PATIENCE)
    assert process.stdout is not None
    assert process.stderr is not None
    every = process.stderr.read().splitlines()
    said = [line for line in every if not line.startswith((NOT_FOR_PATIENTS, "note: "))]
    return status, process.stdout.read(), "\n".join(said).strip()


def recorded(folder: Path, kind: str, more: int = 0) -> list[dict[str, Any]]:
    """Records of a kind, once there are more than so many."""
    end, records = time.monotonic() + PATIENCE, []
    while time.monotonic() < end:
        if (folder / JOURNAL).exists() and (folder / JOURNAL).stat().st_size:
            records = read_journal(folder / JOURNAL)
            of_kind = [record for record in records if record["kind"] == kind]
            if len(of_kind) > more:
                return of_kind
        time.sleep(0.01)
    raise AssertionError(f"no more than {more} records of {kind} in {PATIENCE} s, after {records[-3:]}")


def moves(folder: Path) -> list[str]:
    """Lines with motion that were sent."""
    records = read_journal(folder / JOURNAL)
    return [record["data"] for record in records if record["kind"] == "sent" and "G1" in record["data"]]


def frames_played(firmware: Firmware) -> list[int]:
    program = prepare_trajectory(PLAN, homing_hardware())[0]
    wanted = np.round(program.positions(program.frame_time), 4)
    order = [program.hardware.letters.index(letter) for letter in "XYZABC"]
    ends = np.array([target for _, target in firmware.executed_blocks]).reshape(-1, 6)
    away = abs(ends[:, None] - wanted[None, :, order]).max(axis=2)
    return [int(j) + 1 for row in away for j in np.flatnonzero(row < 2e-4)]


def test_a_plan_on_the_simulated_device(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main([str(plan)]) == 0
    told = capsys.readouterr().out
    out = tmp_path / "runs" / "bench-play"
    assert {path.name for path in out.iterdir()} == {".ctr_nlp", JOURNAL, "tracking.csv", "tracking.png"}
    for words in (
        "success",
        "10 of 10",
        "trusted",
        "frame 10 reached",
        "journal.jsonl, tracking.csv, tracking.png",
    ):
        assert words in told
    with (out / "tracking.csv").open() as file:
        rows = list(csv.DictReader(file))
    program = prepare_trajectory(PLAN, simulated_hardware(PLAN.robot))[0]
    assert [int(row["frame"]) for row in rows] == list(range(1, 11))
    np.testing.assert_allclose([float(row["time_s"]) for row in rows], program.frame_time, atol=1e-6)
    wanted = program.positions(program.frame_time)
    for k, axis in enumerate(program.hardware.axes):
        name = f"{axis.letter} ({axis.unit})"
        commanded = [float(row[f"commanded {name}"]) for row in rows]
        measured = [float(row[f"measured {name}"]) for row in rows]
        np.testing.assert_allclose(commanded, wanted[:, k], atol=1e-9)
        np.testing.assert_allclose(measured, wanted[:, k], atol=0.5)
    assert max(abs(float(row["late_s"])) for row in rows) < 0.1
    assert [r["frame"] for r in read_journal(out / JOURNAL) if r["kind"] == "frame"] == list(range(1, 11))


@unix
def test_a_plan_on_the_emulated_controller(plan: Path, tmp_path: Path) -> None:
    firmware = Firmware({20: 1}, homed=True)
    with serving(firmware, "pty") as url:
        assert (
            main([str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(tmp_path / "out"), LOOKED]) == 0
        )
        assert frames_played(firmware) == list(range(1, 11))
    with (tmp_path / "out" / "tracking.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last["commanded X (mm)"]) == pytest.approx(-12.0)
    assert float(last["measured X (mm)"]) == pytest.approx(-12.0, abs=0.8)  # what it does in 0.1 s


def certified(**words: Verdict) -> Plan:
    """The plan, with verdicts that all read yes but for those given by name."""
    plan = replace(PLAN)
    found = plan.verdicts._replace(**words)
    yes = [each._replace(word=YES) if name not in words else each for name, each in found._asdict().items()]
    plan.__dict__["verdicts"] = type(found)(*yes)
    return plan


NOBODY_LOOKED = Verdict("within the wall", "NOT CHECKED", None, "mm", "No wall of a lumen is known.")


@pytest.fixture
def verdicts(monkeypatch: pytest.MonkeyPatch) -> dict[str, Verdict]:
    """Verdicts, by the names of fields, that the plan which is read does not get a yes for."""
    words: dict[str, Verdict] = {}

    def loaded(path: str | Path) -> Plan:
        return certified(**words)

    monkeypatch.setattr(play_command.Plan, "load", loaded)
    # Verdicts that are made up are none that the independent checker could agree with.
    monkeypatch.setattr(play_command, "require_agreement", lambda path: [])
    return words


def test_a_plan_that_nobody_checked_is_refused(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    with serving(firmware) as url:
        arguments = [str(plan), "--hardware", str(rig(tmp_path, url))]
        assert play([*arguments, "--out", str(out)]) == 2
        first, error = capsys.readouterr().err.splitlines()
        assert play([*arguments, "--dry-run"]) == 2
        assert capsys.readouterr().err.splitlines() == [first, error]
    assert first == NOT_FOR_PATIENTS
    assert error.startswith("error: the plan was not played")
    for verdict in PLAN.verdicts:
        assert (f"{verdict.matter}: {verdict.word} ({verdict.why.rstrip('.')})" in error) == (verdict.word != YES)
    for remedy in (f"`ctr-nlp robust {plan}`", "--free-space", "--uncertified plays it anyway"):
        assert remedy in error
    assert firmware.bytes_received == 0
    assert not out.exists()


@pytest.mark.parametrize("name", PLAN.verdicts._fields)
@pytest.mark.parametrize("word", [NO, "NOT CHECKED"])
def test_each_verdict_alone_refuses_a_plan_and_is_waived(
    name: str, word: str, plan: Path, verdicts: dict[str, Verdict], capsys: pytest.CaptureFixture[str]
) -> None:
    assert play([str(plan), "--dry-run"]) == 0
    verdicts[name] = Verdict(f"the matter of {name}", word, None, "", "Because.")
    capsys.readouterr()
    assert play([str(plan), "--dry-run"]) == 2
    assert f"the matter of {name}: {word} (Because)" in complaint_of(capsys)
    assert play([str(plan), "--dry-run", "--uncertified"]) == 0
    assert f"note: the matter of {name}: {word}. Because." in capsys.readouterr().err
    waived = name == "within_wall" and word != NO
    assert play([str(plan), "--dry-run", "--free-space"]) == (0 if waived else 2)


def test_free_space_is_refused_where_the_plan_has_a_lumen(plan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lumen = np.array([[0.0, 0.0, 0.0, 9.0], [0.0, 0.0, 40.0, 9.0]])
    replace(PLAN, lumen=lumen).save(plan)
    for more in ([], ["--uncertified"]):
        assert play([str(plan), "--dry-run", "--free-space", *more]) == 2
        assert complaint_of(capsys).endswith("nothing surrounds the robot, but the plan has a lumen")
    assert play([str(plan), "--dry-run"]) == 2
    assert "--free-space" not in complaint_of(capsys)


def test_free_space_plays_a_plan_without_a_lumen(
    plan: Path, tmp_path: Path, verdicts: dict[str, Verdict], capsys: pytest.CaptureFixture[str]
) -> None:
    verdicts["within_wall"] = NOBODY_LOOKED
    assert play([str(plan), "--out", str(tmp_path / "out")]) == 2
    assert "--free-space" in complaint_of(capsys)
    assert play([str(plan), "--out", str(tmp_path / "out"), "--free-space"]) == 0


def test_resuming_and_retracting_are_not_asked(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    for more in (["--retract"], ["--resume"]):
        with playing(plan, "--out", out) as process:
            recorded(out, "frame", 2)
            assert process.stdin is not None
            process.stdin.write("a\n")
            process.stdin.flush()
            assert ended(process)[0] == 1
        assert play([str(plan), "--out", str(out), *more]) == 0
        assert NOT_FOR_PATIENTS in capsys.readouterr().err
        (out / JOURNAL).unlink()


def test_another_plan_is_not_resumed(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    assert main([str(plan), "--out", str(out)]) == 0
    replace(PLAN, meta=PLAN.meta | {"seed": 1}).save(plan)
    capsys.readouterr()
    assert play([str(plan), "--out", str(out), "--resume"]) == 2
    assert "the journal is of another plan" in complaint_of(capsys)


def test_what_no_option_waives_is_told_first(plan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    failed = PLAN.success.copy()
    failed[4] = False
    replace(PLAN, success=failed).save(plan)
    for more in ([], ["--uncertified"], ["--free-space"]):
        assert play([str(plan), "--dry-run", *more]) == 2
        assert capsys.readouterr().err.startswith("error: frame 5: the plan has no solution")


def test_a_folder_that_is_named_like_a_file_is_refused(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(plan), "--out", str(tmp_path / "kept.json")]) == 2
    assert "go into a folder; name a folder" in complaint_of(capsys)
    assert not (tmp_path / "kept.json").exists()


def test_a_controller_that_was_not_homed_is_sent_no_motion(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(Firmware({20: 1, 22: 1})) as url:
        arguments = [str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(tmp_path / "out")]
        assert main(arguments) == 1
    assert "home it first (--home)" in capsys.readouterr().err
    assert moves(tmp_path / "out") == []


def test_a_dry_run_opens_nothing(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hardware = rig(tmp_path, "socket://127.0.0.1:1")
    before = sorted(tmp_path.iterdir())
    assert main([str(plan), "--hardware", str(hardware), "--dry-run"]) == 0
    assert "checked; nothing was sent" in capsys.readouterr().out
    assert sorted(tmp_path.iterdir()) == before


@unix
@pytest.mark.parametrize(
    ("number", "status"), [("SIGINT", 130), ("SIGTERM", 143), ("SIGHUP", 129), ("SIGQUIT", 131)]
)
def test_signals_stop_the_robot(number: str, status: int, plan: Path, tmp_path: Path) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    with (
        serving(firmware) as url,
        playing(plan, "--hardware", rig(tmp_path, url), "--out", out, LOOKED) as process,
    ):
        recorded(out, "frame", 3)
        process.send_signal(getattr(signal, number))
        found, told, said = ended(process)
        assert found == status, told + said
        stood = firmware.position
        time.sleep(0.3)
        assert (firmware.position == stood).all()
    result = read_journal(out / JOURNAL)[-3]
    assert (result["kind"], result["outcome"], result["trusted"]) == ("result", "CANCELLED", True)
    np.testing.assert_allclose(result["position"][:3], stood[:3], atol=2e-3)
    assert "stopped on request, after frame" in told
    assert "Traceback" not in said


def test_words_pause_resume_and_abort(plan: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with playing(plan, "--out", out) as process:
        assert process.stdin is not None
        for word, kind, count in (("p", "state", 3), ("r", "state", 4)):
            recorded(out, "frame", 2)
            process.stdin.write(f"{word}\n")
            process.stdin.flush()
            recorded(out, kind, count + 1)
        process.stdin.write("what\nABORT\n")
        process.stdin.flush()
        status, told, said = ended(process)
    assert (status, said) == (1, "")
    states = [r["state"] for r in read_journal(out / JOURNAL) if r["kind"] == "state"]
    assert states[-5:] == ["running", "hold", "running", "homed", "disconnected"]
    assert "cancelled" in told


@unix
@pytest.mark.hazard("late or missing stop")
def test_a_key_at_a_terminal_needs_no_enter(plan: Path, tmp_path: Path) -> None:
    """The program's terminal is a pseudo-terminal, which passes lines on after Enter unless told otherwise."""
    import fcntl
    import pty
    import termios

    def take_terminal() -> None:
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    out = tmp_path / "out"
    ours, theirs = pty.openpty()
    before = termios.tcgetattr(theirs)
    process = subprocess.Popen(
        [sys.executable, "-u", "-m", "ctr_nlp", "play", str(plan), "--out", str(out), ANYWAY],
        stdin=theirs,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=take_terminal,
    )
    try:
        for key, kind, count in ((b"p", "state", 3), (b"r", "state", 4)):
            recorded(out, "frame", 2)
            os.write(ours, key)
            recorded(out, kind, count + 1)
        os.write(ours, b"a")
        status, told, said = ended(process)
        assert status == 1
        assert said == OPERATOR_KEYS
        assert "cancelled" in told
        states = [r["state"] for r in read_journal(out / JOURNAL) if r["kind"] == "state"]
        assert states[-5:] == ["running", "hold", "running", "homed", "disconnected"]
        # The terminal is left as it was found.
        assert termios.tcgetattr(theirs) == before
    finally:
        process.kill()
        process.communicate()
        os.close(ours)
        os.close(theirs)


@unix
def test_killed_in_motion_it_goes_on_without_losing_or_doubling_a_frame(plan: Path, tmp_path: Path) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    with serving(firmware) as url:
        arguments = [plan, "--hardware", rig(tmp_path, url), "--out", out]
        with playing(*arguments, LOOKED) as process:
            recorded(out, "frame", 2)
            process.kill()
            process.wait()
        arguments = [str(argument) for argument in (*arguments, "--resume")]
        assert main(arguments) == 0
        assert frames_played(firmware) == list(range(1, 11))
        assert main(arguments) == 2


@unix
def test_killed_in_motion_it_is_not_played_anew_until_the_tubes_are_back_or_somebody_has_looked(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    start = firmware.position.copy()
    with serving(firmware) as url:
        arguments = [str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(out)]
        with playing(*arguments, LOOKED) as process:
            recorded(out, "frame", 4)
            process.kill()
            process.wait()
        time.sleep(1.0)
        stood = firmware.position.copy()
        for _ in range(2):
            assert main(arguments) == 1
            said = capsys.readouterr().err
            assert "not to be trusted, since a motion had begun, and its end was never recorded" in said
            assert "--position-verified" in said
        assert (firmware.position == stood).all()
        assert main([*arguments, "--retract"]) == 0
        np.testing.assert_allclose(firmware.position, start, atol=5e-3)
        assert main([*arguments, "--resume"]) == 2
        assert main(arguments) == 0


@unix
def test_killed_in_motion_it_is_not_trusted_under_another_spelling_of_its_address(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    with serving(firmware) as url:
        with playing(plan, "--hardware", rig(tmp_path, url), "--out", out, LOOKED) as process:
            recorded(out, "frame", 4)
            process.kill()
            process.wait()
        time.sleep(1.0)
        stood = firmware.position.copy()
        respelled = rig(tmp_path, url.replace("127.0.0.1", "localhost"))
        arguments = [str(plan), "--hardware", str(respelled), "--out", str(tmp_path / "again")]
        assert main(arguments) == 1
        assert "since a motion had begun, and its end was never recorded" in capsys.readouterr().err
        monkeypatch.setenv("CTR_NLP_STATE", str(tmp_path / "state of another user"))
        assert main(arguments) == 1
        assert "there is no record of this device" in capsys.readouterr().err
        assert (firmware.position == stood).all()


@unix
def test_a_second_player_is_refused(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    with serving(firmware) as url:
        arguments = [str(plan), "--hardware", str(rig(tmp_path, url)), "--out"]
        with playing(*arguments, out, LOOKED) as process:
            recorded(out, "frame", 2)
            assert main([*arguments, str(tmp_path / "second")]) == 1
            assert f"another player is connected to {url}: only one may be" in capsys.readouterr().err
            assert ended(process)[0] == 0
    assert frames_played(firmware) == list(range(1, 11))


def bad_plans(path: Path) -> dict[str, str]:
    """Ways to spoil a plan file, and what is said then."""
    whole = path.read_bytes()
    path.with_name("truncated.npz").write_bytes(whole[: len(whole) // 2])
    data = dict(np.load(path, allow_pickle=False))
    np.savez(path.with_name("pickled.npz"), **{**data, "alpha": np.array([{}, []], dtype=object)})
    failed = PLAN.success.copy()
    failed[4] = False
    replace(PLAN, success=failed).save(path.with_name("failed.npz"))
    other = PLAN.beta.copy()
    other[3] += 1.0
    replace(PLAN, beta=other).save(path.with_name("changed.npz"))
    return {"truncated": "", "pickled": "", "failed": "frame 5: the plan has no solution", "changed": "frame 4"}


@pytest.mark.parametrize("kind", ["truncated", "pickled", "failed", "changed", "missing"])
def test_a_bad_plan_is_bad_input_and_nothing_is_sent(
    kind: str, plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    said = bad_plans(plan)
    firmware = Firmware({20: 1}, homed=True)
    with serving(firmware) as url:
        spoilt, out = tmp_path / f"{kind}.npz", tmp_path / "out"
        assert main([str(spoilt), "--hardware", str(rig(tmp_path, url)), "--out", str(out)]) == 2
    captured = complaint_of(capsys)
    assert captured.startswith("error: ")
    assert "\n" not in captured
    assert said.get(kind, kind) in captured
    assert firmware.bytes_received == 0
    if (out / JOURNAL).exists():
        assert not [r for r in read_journal(out / JOURNAL) if r["kind"] == "sent"]


def test_bad_hardware_files_are_bad_input(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    good = rig(tmp_path, "socket://127.0.0.1:1").read_text()
    for text, message in (
        ("not toml", "rig.toml"),
        (good.replace("speed = 50.0", "speed = -1", 1), "speed of beta_1 is -1"),
        (good.replace("approach = 1.0", "approach = 2.0"), "approach is 2"),
        (good.replace("beta_3", "beta_4"), "beta_"),
        (re.sub(r"range = .*", "range = [-20, -15]", good, count=1), "frame 1"),
    ):
        (tmp_path / "rig.toml").write_text(text)
        assert main([str(plan), "--hardware", str(tmp_path / "rig.toml"), "--out", str(tmp_path / "out")]) == 2
        said = complaint_of(capsys)
        assert message in said
        assert "\n" not in said


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--resume", "--home"], "--home does not go with --resume"),
        (["--resume", "--tempo", "0.5"], "--tempo does not go with --resume"),
        (["--resume", "--dry-run"], "--dry-run does not go with --resume"),
        (["--retract", "--resume"], "--resume does not go with --retract"),
        (["--dry-run", "--position-verified"], "--position-verified does not go with --dry-run"),
        (["--commission", "--hardware", "x.toml"], "PLAN.npz does not go with --commission"),
        (["--tempo", "1.5"], "tempo is 1.5; it must lie in (0, 1]"),
    ],
)
def test_options_that_do_not_go_together(
    options: list[str], complaint: str, plan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(plan), *options]) == 2
    assert capsys.readouterr().err.strip() == f"error: {complaint}"


def test_a_plan_or_hardware_that_is_missing_is_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    assert play([]) == 2
    assert "a plan is needed" in capsys.readouterr().err
    assert play(["--commission"]) == 2
    assert "--commission needs --hardware" in capsys.readouterr().err


def test_nobody_listening_is_one_clear_line(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    url = f"socket://127.0.0.1:{port}"
    assert main([str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(tmp_path / "out")]) == 1
    said = complaint_of(capsys)
    assert said.startswith(f"error: {url} cannot be opened")
    assert "Traceback" not in said


# pyserial forgets to close a socket that the other end has closed
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_unplugged_in_motion(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    found: list[int] = []
    with serving(firmware) as url:
        arguments = [str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(out), LOOKED]
        thread = threading.Thread(target=lambda: found.append(main_here(arguments)))
        thread.start()
        recorded(out, "frame", 3)
    thread.join(10)
    assert found == [1]
    result = next(r for r in read_journal(out / JOURNAL) if r["kind"] == "result" and r["outcome"] != "SUCCESS")
    assert (result["outcome"], result["trusted"]) == ("DEVICE_FAULT", False)
    assert "not to be trusted" in capsys.readouterr().out


def main_here(arguments: list[str]) -> int:
    """The program in a thread, where there are no signals."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(signal, "signal", lambda *_: signal.SIG_DFL)
        return main(arguments)


def test_what_earlier_sessions_left_is_not_taken_for_this_one(plan: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    for name in (".ctr_nlp", "tracking.csv", "tracking.png"):
        (out / name).touch()
    url = "socket://127.0.0.1:1"
    assert main([str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(out)]) == 1
    assert {path.name for path in out.iterdir()} == {".ctr_nlp", JOURNAL}


@pytest.mark.parametrize("name", ["../../x", "/x", ".."])
def test_a_plan_s_name_makes_no_path(
    plan: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    found = Plan.load(plan)
    replace(found, meta=found.meta | {"problem": found.meta["problem"] | {"name": name}}).save(plan)
    work = tmp_path / "deep" / "deeper"
    work.mkdir(parents=True)
    monkeypatch.chdir(work)
    hardware = rig(tmp_path, "socket://127.0.0.1:1")
    before = set(tmp_path.rglob("*"))
    assert main([str(plan), "--hardware", str(hardware)]) == 1
    (out,) = (work / "runs").iterdir()
    assert out.name.endswith("-play")
    assert set(tmp_path.rglob("*")) - before == {out.parent, out, out / MARK, out / JOURNAL}


@pytest.mark.parametrize("name", ["tracking.csv", JOURNAL])
def test_files_of_the_user_s_in_its_folder_are_refused(plan: Path, tmp_path: Path, name: str) -> None:
    out, arguments = tmp_path / "out", [str(plan), "--hardware", str(rig(tmp_path, "socket://127.0.0.1:1"))]
    assert main([*arguments, "--out", str(out)]) == 1
    (out / name).write_text("mine")
    (out / "notes.txt").write_text("mine")
    before = {path: path.read_bytes() for path in out.iterdir()}
    assert main([*arguments, "--out", str(out)]) == 2
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_beside_a_plan_the_plan_stays_and_the_journal_grows(plan: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with output_folder(out, "plan") as staging:
        Plan.load(plan).save(staging / "plan.npz")
    before, sizes = (out / "plan.npz").read_bytes(), []
    for _ in range(2):
        url = "socket://127.0.0.1:1"
        assert main([str(out / "plan.npz"), "--hardware", str(rig(tmp_path, url)), "--out", str(out)]) == 1
        sizes.append((out / JOURNAL).stat().st_size)
    assert (out / "plan.npz").read_bytes() == before
    assert 0 < sizes[0] < sizes[1]
    check_folder(out, "plan")


def test_a_result_stands_where_its_table_cannot_be_published(plan: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with playing(plan, "--out", out) as process:
        recorded(out, "frame", 1)
        (out / "tracking.csv").write_text("mine")
        status, told, said = ended(process)
    assert (status, said.count("tracking.csv is in the way")) == (1, 1)
    assert (out / "tracking.csv").read_text() == "mine"
    assert (tmp_path / "out-kept-1" / "tracking.csv").is_file()
    assert f"wrote {out}: {JOURNAL}" in told.replace("\n", "")


NO_SPACE = "No space left on device"


def test_a_session_whose_journal_cannot_be_ended_is_not_all_well(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, write = tmp_path / "out", os.write

    def full(file: int, data: bytes) -> int:
        if b'"kind": "result"' in data:
            raise OSError(28, NO_SPACE)
        return write(file, data)

    monkeypatch.setattr(journal_module.os, "write", full)
    assert main([str(plan), "--out", str(out)]) == 1
    told = capsys.readouterr()
    assert told.err.count(f"error: journal {out / JOURNAL} cannot be written: [Errno 28] {NO_SPACE}") == 1
    assert "success" in told.out
    assert "tracking.csv" in told.out
    assert JOURNAL not in told.out


def test_a_position_that_cannot_be_remembered_is_not_all_well(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    firmware, out, whole = Firmware({20: 1}, homed=True), tmp_path / "out", trust_module.write_atomically

    def full(path: Path) -> Any:
        if moves(out):
            raise OSError(28, NO_SPACE)
        return whole(path)

    with serving(firmware) as url:
        arguments = [str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(out)]
        with monkeypatch.context() as patch:
            patch.setattr(trust_module, "write_atomically", full)
            assert main([*arguments, LOOKED]) == 1
        told = capsys.readouterr()
        assert "trusted, but not remembered" in told.out
        assert f"cannot be saved in {os.environ['CTR_NLP_STATE']}" in told.err
        assert NO_SPACE in told.err
        assert main(arguments) == 1
    assert "its end was never recorded" in capsys.readouterr().err


def test_it_refuses_a_folder_that_is_not_ours(plan: Path, tmp_path: Path) -> None:
    assert main([str(plan), "--out", str(tmp_path)]) == 2
    assert not (tmp_path / JOURNAL).exists()
    assert os.listdir(tmp_path) == ["plan.npz"]
    assert Plan.load(plan).robot.d == table_i_robot().d
