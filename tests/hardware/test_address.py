"""One device has one name, however its address is spelled."""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import pytest

from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware import device_factory
from ctr_nlp.hardware.address import canonical_address
from ctr_nlp.hardware.description import Connection
from ctr_nlp.hardware.playing.trust import Remembered

HOSTS = {
    "rig": ["192.0.2.7"],
    "rig.example.org": ["2001:db8::7", "192.0.2.7"],
    "192.0.2.7": ["192.0.2.7"],
    "::ffff:192.0.2.7": ["::ffff:192.0.2.7"],
    "other": ["192.0.2.8"],
    "localhost": ["::1", "127.0.0.1"],
    "127.0.0.1": ["127.0.0.1"],
    "127.0.1.1": ["127.0.1.1"],
    "::1": ["::1"],
    "0.0.0.0": ["0.0.0.0"],
}
"""Addresses of hosts, as a name server would tell them."""


@pytest.fixture
def hosts(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(host: str, *_: Any, **__: Any) -> list[tuple[Any, ...]]:
        if host not in HOSTS:
            raise socket.gaierror("no such host")
        return [(None, None, None, "", (address, 0)) for address in HOSTS[host]]

    monkeypatch.setattr(socket, "getaddrinfo", found)


def name(url: str, device: str = "grbl") -> str:
    return canonical_address(Connection(device, url))


@pytest.mark.usefixtures("hosts")
@pytest.mark.parametrize(
    "urls",
    [
        ("socket://rig:23", "socket://RIG:23", "socket://rig.example.org:23", "socket://192.0.2.7:23"),
        (
            "socket://192.0.2.7:23",
            "socket://[::ffff:192.0.2.7]:23",
            "rfc2217://rig:23",
            "socket://rig:23/logging=x",
        ),
        ("socket://127.0.0.1:23", "socket://localhost:23", "socket://[::1]:23", "socket://0.0.0.0:23"),
        ("socket://localhost:23", "socket://127.0.1.1:23"),
        ("socket://unknown:23", "socket://Unknown:23"),
    ],
)
def test_spellings_of_one_device(urls: tuple[str, ...]) -> None:
    assert len(set(map(name, urls))) == 1


@pytest.mark.usefixtures("hosts")
def test_devices_that_differ_have_names_that_differ() -> None:
    urls = ["socket://rig:23", "socket://rig:24", "socket://other:23", "socket://localhost:23", "/dev/ttyUSB0"]
    assert len(set(map(name, urls))) == len(urls)


def test_own_addresses_are_this_machine() -> None:
    here = socket.gethostname()
    try:
        socket.getaddrinfo(here, None)
    except OSError:
        pytest.skip("this machine cannot find itself by its name")
    assert name(f"socket://{here}:23") == name("socket://localhost:23")


def test_links_to_a_serial_port_are_followed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "ttyUSB0").touch()
    link = tmp_path / "by-id"
    link.symlink_to("ttyUSB0")
    monkeypatch.chdir(tmp_path)
    assert name(str(link)) == name(str(tmp_path / "ttyUSB0")) == name("ttyUSB0")
    assert name(str(tmp_path / "ttyUSB1")) != name("ttyUSB0")


@pytest.mark.usefixtures("hosts")
def test_a_ros_2_controller_is_named_by_host_and_domain() -> None:
    assert name("ctr@rig", "ros2") == name("/ctr@192.0.2.7", "ros2")
    assert name("ctr", "ros2") == name("ctr@localhost?domain=0", "ros2")
    assert name("ctr", "ros2") != name("ctr?domain=7", "ros2")


@pytest.mark.parametrize(
    "url", ["spy:///dev/ttyUSB0", "hwgrep://Arduino", "socket://rig", "socket://:23", "socket://rig:x"]
)
def test_a_url_that_names_no_one_device_is_refused(url: str) -> None:
    with pytest.raises(HardwareError, match="must be the path of a serial port, such as /dev/ttyUSB0, or a host"):
        Connection("grbl", url)


def test_what_is_remembered_follows_the_device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Opened by another name, a device is still known, and still has one player."""
    monkeypatch.setenv("CTR_NLP_STATE", str(tmp_path / "state"))
    (tmp_path / "port").touch()
    (tmp_path / "link").symlink_to("port")
    port, link = (device_factory.memory_of(Connection("grbl", str(tmp_path / each))) for each in ("port", "link"))
    assert port is not None
    assert link is not None
    port.claim()
    port.write("controller", Remembered(False, "it fell"))
    with pytest.raises(DeviceFault, match=r"another player is connected to .*link"):
        link.claim()
    port.release()
    assert link.read("controller") == Remembered(False, "it fell")
