"""`ctr-nlp play --closed-loop` as a user runs it: an emulated controller, and a tracker that tells by UDP."""

from __future__ import annotations

import csv
import json
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bench import homing_hardware, sweep
from emulator.firmware import Firmware
from emulator.serve import serving
from test_play import complaint_of, main, toml

from ctr_nlp import Plan, Tolerances
from ctr_nlp.cli.commands.play import JOURNAL
from ctr_nlp.hardware.description import simulated_hardware
from ctr_nlp.hardware.journal import read_journal
from ctr_nlp.identify.closed_loop.plant import Plant
from ctr_nlp.robot.samples import sample_robots

pytestmark = pytest.mark.real_time

HARDWARE = homing_hardware()


def made() -> Plan:
    """Thirty frames in 3 s, of a robot whose motors' zeros are not known well."""
    plan = sweep(30)
    robot = replace(plan.robot, tolerances=Tolerances(0.05, 0.05, motor_zero=0.1))
    return replace(plan, meta={**plan.meta, "robot": robot.to_dict()})


PLAN = made()


@pytest.fixture(autouse=True)
def no_words(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is typed: the thread that would read it ends."""
    monkeypatch.setattr(sys, "stdin", None)


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    PLAN.save(tmp_path / "plan.npz")
    return tmp_path / "plan.npz"


class Tracker(threading.Thread):
    """Looks 20 times a second at the tip of a robot that follows an emulated controller, and tells of it by UDP.

    until: how many times it tells, then never again. Its frame is 10 mm off along x.
    """

    def __init__(self, firmware: Firmware, port: int, until: int) -> None:
        super().__init__(daemon=True)
        self._firmware, self._port, self._until, self._ended = firmware, port, until, threading.Event()
        self._plant = Plant(PLAN.robot, sample_robots(PLAN.robot, 1, 3), PLAN.evaluated_model_name)

    def run(self) -> None:
        with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
            random = np.random.default_rng(1)
            for k in range(self._until):
                columns = ["XYZABC".index(letter) for letter in HARDWARE.letters]
                q = HARDWARE.joints(PLAN.robot, np.array(self._firmware.position)[columns], np.zeros(2))
                tip = self._plant.move_to(q, 0.05 * k).shape[-1] + 0.5 * random.standard_normal(3)
                values = (tip + np.array([10.0, 0.0, 0.0])).tolist()
                sender.sendto(json.dumps({"values": values}).encode(), ("127.0.0.1", self._port))
                if self._ended.wait(0.05):
                    return

    def close(self) -> None:
        self._ended.set()
        self.join()


@contextmanager
def stage(tmp_path: Path, until: int = 10**6) -> Iterator[list[str]]:
    """The arguments with which a plan is played in a closed loop."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    firmware = Firmware({20: 1}, homed=True)
    with serving(firmware) as url:
        connection = replace(HARDWARE.connection, url=url)
        path = toml(replace(HARDWARE, connection=connection), tmp_path / "rig.toml")
        table = f'[sensing]\nurl = "udp://127.0.0.1:{port}"\ntranslation = [-10, 0, 0]\n'
        path.write_text(path.read_text() + table)
        tracker = Tracker(firmware, port, until)
        tracker.start()
        try:
            yield ["--hardware", str(path), "--out", str(tmp_path / "out")]
        finally:
            tracker.close()


def test_a_tracker_that_tells_by_udp_corrects_a_plan(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with stage(tmp_path) as arguments:
        assert main([str(plan), "--closed-loop", "--position-verified", *arguments]) == 0
        told = capsys.readouterr()
        assert "success" in told.out
        assert "30 of 30" in told.out
        assert "the robot is" not in told.err
        assert "motor_zero of tube 1" in told.out
        assert "estimate.csv" in told.out
        assert main([str(plan), "--replay", *arguments]) == 0
        assert ": the same as in the journal, bit for bit" in capsys.readouterr().out
    records = read_journal(tmp_path / "out" / JOURNAL)
    assert sum(len(r["readings"]) for r in records if r["kind"] == "sensed") > 30
    assert sum(r["kind"] == "corrected" for r in records) > 8
    with (tmp_path / "out" / "estimate.csv").open() as file:
        rows = list(csv.DictReader(file))
    name = "deviation of motor_zero of tube 1"
    assert float(rows[-1][name]) < float(rows[0][name])


def test_where_a_tracker_falls_silent_the_operator_is_told_and_the_plan_goes_on(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with stage(tmp_path, until=1) as arguments:
        assert main([str(plan), "--closed-loop", "--position-verified", *arguments]) == 0
    told = capsys.readouterr()
    assert "note: no measurement for 0." in told.err
    assert "on its plan, not corrected" in told.out
    assert "30 of 30" in told.out


def test_an_open_loop_has_nothing_to_be_worked_out_again(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with stage(tmp_path, until=1) as arguments:
        assert main([str(plan), "--position-verified", *arguments]) == 0
        capsys.readouterr()
        assert main([str(plan), "--replay", *arguments]) == 2
        assert "played without --closed-loop" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--closed-loop"], "a closed loop needs a sensor: --sensor URL, or a table [sensing]"),
        (["--sensor", "simulated"], "--sensor goes with --closed-loop"),
        (["--closed-loop", "--sensor", "file:x"], "url of the sensor is 'file:x'; it must be simulated"),
        (["--closed-loop", "--sensor", "simulated", "--retract"], "--closed-loop does not go with --retract"),
        (["--replay", "--sensor", "simulated", "--resume"], "--resume does not go with --replay"),
        (["--replay", "--sensor", "simulated"], "journal"),
        (["--commission", "--sensor", "simulated"], "PLAN.npz does not go with --commission"),
    ],
)
def test_options_that_do_not_fit_are_one_clear_line(
    options: list[str], complaint: str, plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(plan), *options, "--out", str(tmp_path / "out")]) == 2
    said = complaint_of(capsys)
    assert said.startswith("error: ")
    assert complaint in said
    assert "\n" not in said


def test_a_robot_that_is_exactly_known_has_nothing_to_be_learnt_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = replace(PLAN.robot, tolerances=Tolerances(0.0, 0.0, motor_zero=0.0))
    replace(PLAN, meta={**PLAN.meta, "robot": robot.to_dict()}).save(tmp_path / "exact.npz")
    options = ["--closed-loop", "--sensor", "simulated", "--out", str(tmp_path / "out")]
    assert main([str(tmp_path / "exact.npz"), *options]) == 2
    assert "tolerances of the robot are all 0" in capsys.readouterr().err


def test_a_sensor_that_cannot_be_listened_to_ends_it_before_anything_moves(
    plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--closed-loop", "--sensor", "tcp://127.0.0.1:1", "--out", str(tmp_path / "out")]
    assert main([str(plan), *options]) == 1
    assert "tcp://127.0.0.1:1 cannot be listened to" in capsys.readouterr().err
    assert not [r for r in read_journal(tmp_path / "out" / JOURNAL) if r["kind"] == "start"]


def test_a_dry_run_tells_what_room_for_corrections_costs(plan: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([str(plan), "--dry-run", "--closed-loop", "--sensor", "simulated"]) == 0
    told = capsys.readouterr().out
    assert "largest part of an acceleration limit  0.5" in " ".join(told.split()).replace(" limit ", " limit  ")


def test_a_plan_that_is_not_known_to_hold_is_warned_of_before_it_starts(
    plan: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([str(plan), "--dry-run", "--closed-loop", "--sensor", "simulated"]) == 0
    (told,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert "the robot may snap on this plan" in told
    assert "holds on built robots: NOT CHECKED" in told
    assert "exit status 1" in told
    assert main([str(plan), "--dry-run"]) == 0
    assert "warning: " not in capsys.readouterr().err


@pytest.mark.parametrize("seed", [0, 7])
def test_the_simulated_robot_is_elastic_and_said_which_it_is(
    seed: int, plan: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert PLAN.evaluated_model_name == "dominant"
    rig = toml(replace(simulated_hardware(PLAN.robot), arm=None), tmp_path / "rig.toml")
    noise = 0.01  # mm, less than what tells the models apart
    rig.write_text(rig.read_text() + f'[sensing]\nurl = "simulated:{seed}"\ndeviation = {noise}\n')
    arguments = ["--closed-loop", "--hardware", str(rig), "--out", str(tmp_path / "out")]
    assert main([str(plan), *arguments]) == 0
    (told,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("sensor: ")]
    sample = sample_robots(PLAN.robot, 1, seed)
    zeros = ", ".join(f"{zero:+.3g}" for zero in sample.offsets[0])
    assert told.startswith(f"sensor: a simulated robot on the elastic model, seed {seed}: curvature ")
    assert told.endswith(f"motor zero {zeros} rad")
    records = read_journal(tmp_path / "out" / JOURNAL)
    looks = [record for record in records if record["kind"] == "sensed" and record["readings"]]
    elastic = Plant(PLAN.robot, sample, "elastic")
    elastic.move_to(PLAN.q[0], 0.0)
    away = []
    for record in looks:
        tip = elastic.move_to(np.array(record["q"]), record["now"]).shape[-1]
        away += [np.linalg.norm(np.array(values) - tip) for _, values in record["readings"]]
    assert len(away) > 10
    assert np.sqrt(np.mean(np.square(away)) / 3) == pytest.approx(noise, rel=0.3)
