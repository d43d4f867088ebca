"""Every device that a hardware file may name is built, and explained where people look for it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from emulator.wire import VirtualClock

from ctr_nlp import table_i_robot
from ctr_nlp.exceptions import HardwareError
from ctr_nlp.hardware import description
from ctr_nlp.hardware.description import MOTOR_DEVICES, Connection, Hardware, simulated_hardware
from ctr_nlp.hardware.device_factory import device_of
from ctr_nlp.hardware.devices import Device
from ctr_nlp.hardware.journal import Journal

TEMPLATE = Path(description.__file__).parents[1] / "cli" / "templates" / "hardware.toml"
URLS = {"grbl": "socket://127.0.0.1:23", "ros2": "joint_trajectory_controller"}
"""Any url of the device; others take a host and a port."""
METHODS = [name for name, part in vars(Device).items() if not name.startswith("_") and callable(part)]


def hardware_with(device: str) -> Hardware:
    url = "" if device == "simulated" else URLS.get(device, "tcp://127.0.0.1:23")
    return replace(simulated_hardware(table_i_robot()), connection=Connection(device, url))


def built(hardware: Hardware, folder: Path) -> Device:
    clock = VirtualClock()
    return device_of(hardware, Journal(folder / "journal.jsonl", clock), clock, np.zeros(len(hardware.axes)))


def test_every_name_has_a_device_of_its_own(tmp_path: Path) -> None:
    devices = [built(hardware_with(name), tmp_path) for name in MOTOR_DEVICES]
    assert len({type(device) for device in devices}) == len(MOTOR_DEVICES)
    assert len(METHODS) >= 6
    for device in devices:
        assert [name for name in METHODS if not callable(getattr(device, name, None))] == []


def test_a_name_without_a_device_is_not_simulated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(description, "MOTOR_DEVICES", (*MOTOR_DEVICES, "other"))
    with pytest.raises(HardwareError, match="device of the connection is 'other', which device_of does not"):
        built(hardware_with("other"), tmp_path)


def test_the_template_and_the_connection_name_every_device() -> None:
    connection = TEMPLATE.read_text(encoding="utf-8").partition("[connection]\n")[2]
    line = connection.splitlines()[0]
    assert line.startswith("device = ")
    assert set(re.findall(r"[\w-]+", line.partition("#")[2])) - {"or"} == set(MOTOR_DEVICES)
    assert [name for name in MOTOR_DEVICES if f'"{name}"' not in str(Connection.__doc__)] == []
