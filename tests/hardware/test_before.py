"""Files and names of before the house was rebuilt: they are read as they were, and mean the same."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import pytest

from ctr_nlp import exceptions
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.journal import read_journal
from ctr_nlp.hardware.playing.session import check_trusted, find_program_record, last_passed, session_of

FILE = """
name = "a rig of before"
approach = 0.3
late = 0.8

[connection]
device = "grbl"
url = "/dev/ttyUSB0"
baud = 250000
homing = "cycle"
flow = "wait"

[[axes]]
joint = "beta_1"
letter = "X"
unit = "mm"
range = [-51, -1]
speed = 50
acceleration = 200
sign = -1
zero = -1
backlash = 0.1
tolerance = 0.4

[[axes]]
joint = "alpha_1"
letter = "A"
unit = "deg"
range = [-1080, 1080]
speed = 600
acceleration = 2000

[arm]
model = "ur5e"
insertion_point = [450, 0, 300]
insertion_rotation_deg = [0, 135, 0]
mount_translation = [125, 0, 60]
mount_rotation_deg = [0, 90, 0]
start_joints_deg = [0, -90, 90, 0, 90, 0]
joint_speed_deg = 120
joint_acceleration_deg = [700, 700, 700, 800, 800, 800]
tilt_speed_deg = [30, 20]
tilt_acceleration_deg = 100
skew_tolerance = 0.2
host = "192.168.1.5"
device = "ur"
"""

DIGEST = "22ddd0a94fb7daf5c78b51d68b34fcf835423d5b943575fd0fc6ba37b9409beb"
"""SHA-256 of what this file described: it stands in journals, and a session is resumed only where it agrees."""

JOURNAL = [
    {"t": 0.0, "kind": "session", "id": "5e55", "wall": 1.7e9, "pid": 7},
    {"t": 0.1, "kind": "state", "state": "homed"},
    {"t": 0.2, "kind": "program", "plan": "a1", "hardware": "b2", "tempo": 0.5, "standing": [0.0] * 6}
    | {"parameter": None, "first": 0, "last": 20, "duration": 4.0},
    {"t": 0.3, "kind": "sent", "data": "N1 G1 X1.0000 F600.0000\n"},
    {"t": 0.4, "kind": "frame", "frame": 1, "position": [0.5] * 6},
    {"t": 0.5, "kind": "wish", "wish": "abort"},
    {"t": 0.6, "kind": "result", "outcome": "CANCELLED", "message": "stopped on request", "frame": 1}
    | {"position": [0.6] * 6, "trusted": False},
]


def test_a_hardware_file_of_before_describes_the_same(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(FILE, encoding="utf-8")
    hardware = replace(Hardware.from_toml(path), commissioned=None)
    assert hardware.arm is not None
    assert hashlib.sha256(repr(hardware).encode()).hexdigest() == DIGEST


def test_a_journal_of_before_tells_what_was_played(tmp_path: Path) -> None:
    path = tmp_path / "journal.jsonl"
    path.write_text("".join(json.dumps(record) + "\n" for record in JOURNAL), encoding="utf-8")
    records = read_journal(path)
    assert find_program_record(records)["standing"] == [0.0] * 6
    assert find_program_record(records)["tempo"] == 0.5
    assert (last_passed(records), session_of(records)) == (1, "5e55")
    with pytest.raises(exceptions.TrajectoryError, match="not to be trusted"):
        check_trusted(records, verified=False)
    check_trusted(records, verified=True)


def test_the_exceptions_name_of_before_is_still_caught() -> None:
    with pytest.warns(DeprecationWarning, match="TrajectoryError"):
        old = exceptions.ProgramError
    assert old is exceptions.TrajectoryError
    with pytest.raises(AttributeError, match="NoSuchError"):
        exceptions.NoSuchError  # noqa: B018
