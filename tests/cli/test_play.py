"""The program scripts/play.py as a user runs it: in real time, on simulated and emulated devices, interrupted."""

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

from ctr_nlp import Plan, table_i_robot
from ctr_nlp.cli.commands.play import JOURNAL, main
from ctr_nlp.cli.output.folder import check_folder, published
from ctr_nlp.cli.output.manifest import MARK
from ctr_nlp.hardware.description import Hardware, bench
from ctr_nlp.hardware.emulator.firmware import Firmware
from ctr_nlp.hardware.emulator.serve import serving
from ctr_nlp.hardware.journal import read_journal
from ctr_nlp.hardware.playing.session import prepared

pytestmark = pytest.mark.real_time

SCRIPT = Path(__file__).resolve().parents[2] / "scripts" / "play.py"
PLAN = sweep(10)
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


def rig(tmp_path: Path, url: str) -> Path:
    hardware = homing_hardware()
    return toml(replace(hardware, connection=replace(hardware.connection, url=url)), tmp_path / "rig.toml")


@contextmanager
def playing(*arguments: Any) -> Iterator[subprocess.Popen[str]]:
    """The program in a process of its own."""
    process = subprocess.Popen(
        [sys.executable, "-u", str(SCRIPT), *map(str, arguments)],
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
    return status, process.stdout.read(), process.stderr.read().strip()


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
    program = prepared(PLAN, homing_hardware())[0]
    wanted = np.round(program.positions(program.frame_time), 4)
    order = [program.hardware.letters.index(letter) for letter in "XYZABC"]
    ends = np.array([target for _, target in firmware.executed]).reshape(-1, 6)
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
    program = prepared(PLAN, bench(PLAN.robot))[0]
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
        assert main([str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(tmp_path / "out")]) == 0
        assert frames_played(firmware) == list(range(1, 11))
    with (tmp_path / "out" / "tracking.csv").open() as file:
        last = list(csv.DictReader(file))[-1]
    assert float(last["commanded X (mm)"]) == pytest.approx(-12.0)
    assert float(last["measured X (mm)"]) == pytest.approx(-12.0, abs=0.8)  # what it does in 0.1 s


def test_a_controller_that_was_not_homed_is_sent_no_motion(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(Firmware({20: 1, 22: 1})) as url:
        arguments = [str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(tmp_path / "out")]
        assert main(arguments) == 1
    assert "let it home first" in capsys.readouterr().err
    assert moves(tmp_path / "out") == []


def test_a_dry_run_opens_nothing(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    hardware = rig(tmp_path, "socket://127.0.0.1:1")
    before = sorted(tmp_path.iterdir())
    assert main([str(plan), "--hardware", str(hardware), "--dry-run"]) == 0
    assert "checked; nothing was sent" in capsys.readouterr().out
    assert sorted(tmp_path.iterdir()) == before


@unix
@pytest.mark.parametrize(("number", "status"), [("SIGINT", 130), ("SIGTERM", 1)])
def test_signals_stop_the_robot(number: str, status: int, plan: Path, tmp_path: Path) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    with serving(firmware) as url, playing(plan, "--hardware", rig(tmp_path, url), "--out", out) as process:
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
def test_killed_in_motion_it_goes_on_without_losing_or_doubling_a_frame(plan: Path, tmp_path: Path) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    with serving(firmware) as url:
        arguments = [plan, "--hardware", rig(tmp_path, url), "--out", out]
        with playing(*arguments) as process:
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
        with playing(*arguments) as process:
            recorded(out, "frame", 4)
            process.kill()
            process.wait()
        time.sleep(1.0)
        stood = firmware.position.copy()
        for _ in range(2):
            assert main(arguments) == 1
            said = capsys.readouterr().err
            assert "not to be trusted, since a motion had begun, and its end was never told" in said
            assert "--position-verified" in said
        assert (firmware.position == stood).all()
        assert main([*arguments, "--retract"]) == 0
        np.testing.assert_allclose(firmware.position, start, atol=5e-3)
        assert main([*arguments, "--resume"]) == 2
        assert main(arguments) == 0


@unix
def test_a_second_player_is_refused(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    with serving(firmware) as url:
        arguments = [str(plan), "--hardware", str(rig(tmp_path, url)), "--out"]
        with playing(*arguments, out) as process:
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
    captured = capsys.readouterr().err.strip()
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
        said = capsys.readouterr().err.strip()
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
    assert main([]) == 2
    assert "a plan is needed" in capsys.readouterr().err
    assert main(["--commission"]) == 2
    assert "--commission needs --hardware" in capsys.readouterr().err


def test_nobody_listening_is_one_clear_line(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    url = f"socket://127.0.0.1:{port}"
    assert main([str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(tmp_path / "out")]) == 1
    said = capsys.readouterr().err.strip()
    assert said.startswith(f"error: {url} cannot be opened")
    assert "Traceback" not in said


# pyserial forgets to close a socket that the other end has closed
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_unplugged_in_motion(plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    firmware, out = Firmware({20: 1}, homed=True), tmp_path / "out"
    found: list[int] = []
    with serving(firmware) as url:
        arguments = [str(plan), "--hardware", str(rig(tmp_path, url)), "--out", str(out)]
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
    with published(out, "plan") as staging:
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
    assert (status, said.count("tracking.csv is in the way")) == (0, 1)
    assert (out / "tracking.csv").read_text() == "mine"
    assert (tmp_path / "out-kept-1" / "tracking.csv").is_file()
    assert f"wrote {out}: {JOURNAL}" in told.replace("\n", "")


def test_it_refuses_a_folder_that_is_not_ours(plan: Path, tmp_path: Path) -> None:
    assert main([str(plan), "--out", str(tmp_path)]) == 2
    assert not (tmp_path / JOURNAL).exists()
    assert os.listdir(tmp_path) == ["plan.npz"]
    assert Plan.load(plan).robot.d == table_i_robot().d
