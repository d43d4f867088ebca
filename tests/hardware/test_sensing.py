"""Who tells of the robot's shape: descriptions, JSON over sockets, OpenIGTLink, ROS 2, clocks and frames."""

from __future__ import annotations

import json
import os
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import DeviceFault, HardwareError
from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.sensing.arrival import receive_bytes, stamp_arrivals
from ctr_nlp.hardware.sensing.description import Sensing, parse_sensor_url
from ctr_nlp.hardware.sensing.igtl import Igtl
from ctr_nlp.hardware.sensing.lines import JsonLineSource, message_of
from ctr_nlp.hardware.sensing.source import OLDEST, Message, Remote
from ctr_nlp.identify.closed_loop.sensors import Reading

EXAMPLE = Path(__file__).parents[2] / "examples" / "hardware.toml"
NOWHERE = np.zeros(8)


class Sent(Remote):
    """What a test sends."""

    def __init__(self, sensing: Sensing) -> None:
        super().__init__(sensing)
        self.waiting: list[Message] = []

    def open(self) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""

    def _receive_messages(self) -> list[Message]:
        come, self.waiting = self.waiting, []
        return come

    def send(self, now: float, *stamps: float | None) -> list[Reading]:
        self.waiting = [Message(np.arange(3.0), stamp) for stamp in stamps]
        return self.take(NOWHERE, now)


@pytest.mark.parametrize(
    ("url", "meant"),
    [
        ("simulated", ("simulated", "", 0, "0")),
        ("simulated:7", ("simulated", "", 0, "7")),
        ("udp://0.0.0.0:5005", ("udp", "0.0.0.0", 5005, "")),
        ("tcp://tracker.local:9000", ("tcp", "tracker.local", 9000, "")),
        ("igtl://127.0.0.1:18944/Tip Sensor", ("igtl", "127.0.0.1", 18944, "Tip Sensor")),
        ("ros2://ctr/tip", ("ros2", "", 0, "ctr/tip")),
        ("ros2://ctr/tip@192.168.1.5?domain=7", ("ros2", "", 0, "ctr/tip@192.168.1.5?domain=7")),
    ],
)
def test_urls(url: str, meant: tuple[Any, ...]) -> None:
    assert tuple(parse_sensor_url(url)) == meant


@pytest.mark.parametrize(
    "url",
    [
        "",
        "udp",
        "udp://:5005",
        "udp://a:0",
        "tcp://a:70000",
        "tcp://a:1/b",
        "igtl://a:1",
        "simulated:x",
        "ros2:/a",
    ],
)
def test_other_urls_are_refused_with_what_they_may_be(url: str) -> None:
    with pytest.raises(HardwareError, match=r"url of the sensor is .*udp://HOST:PORT"):
        Sensing(url)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"measures": "shape"}, "measures of the sensor is 'shape'; it must be tip, pose, points"),
        ({"measures": "points"}, "places of the sensor are"),
        ({"places": [0.5]}, "places of the sensor are"),
        ({"measures": "points", "places": [0.5, 1.5]}, r"must be one or more numbers in \[0, 1\]"),
        ({"deviation": 0}, "deviation"),
        ({"measures": "pose", "turn": -1}, "deviation of the tip's direction"),
        ({"delay": 2}, r"delay of the sensor is 2 s; it must lie in \[0, 1\)"),
        ({"translation": [1, 2]}, "translation of the sensor"),
        ({"rotation_deg": ["a", 0, 0]}, "rotation_deg of the sensor"),
    ],
)
def test_what_no_sensor_can_be_is_one_clear_error(given: dict[str, Any], said: str) -> None:
    with pytest.raises(HardwareError, match=said):
        Sensing(**given)


def test_a_hardware_file_describes_it(tmp_path: Path) -> None:
    text = EXAMPLE.read_text(encoding="utf-8")
    assert Hardware.from_toml(EXAMPLE).sensing == Sensing()
    text = text[: text.index("[sensing]")] + text[text.index("# One table") :]
    table = (
        '\n[sensing]\nurl = "tcp://127.0.0.1:9"\nmeasures = "points"\nplaces = [0.5, 1]\ntranslation = [1, 2, 3]\n'
    )
    (tmp_path / "rig.toml").write_text(text + table)
    sensing = Hardware.from_toml(tmp_path / "rig.toml").sensing
    assert sensing == Sensing("tcp://127.0.0.1:9", "points", (0.5, 1), translation=(1.0, 2.0, 3.0))
    (tmp_path / "rig.toml").write_text(text + table.replace("places", "sigma"))
    with pytest.raises(HardwareError, match=r"rig\.toml: key 'sigma' is unknown in sensing"):
        Hardware.from_toml(tmp_path / "rig.toml")


def test_values_are_placed_in_the_robot_s_frame() -> None:
    turned, moved = Rotation.from_euler("xyz", [10, -20, 30], degrees=True), np.array([1.0, 2.0, 3.0])
    frame = {"translation": moved.tolist(), "rotation_deg": (10, -20, 30)}
    point, direction = np.array([4.0, -5.0, 60.0]), np.array([0.6, 0.0, 0.8])
    pose = Sensing(measures="pose", **frame).to_base_frame(np.concatenate([point, direction]))
    assert pose == pytest.approx(np.concatenate([turned.apply(point) + moved, turned.apply(direction)]))
    both = Sensing(measures="points", places=(0.5, 1.0), **frame).to_base_frame(
        np.concatenate([point, [np.nan] * 3])
    )
    assert both[:3] == pytest.approx(turned.apply(point) + moved)
    assert np.isnan(both[3:]).all()


def test_times_of_another_clock_become_ours_by_the_quickest_message() -> None:
    """The sender's clock is 100 s ahead; messages are under way for 20 to 70 ms."""
    source = Sent(Sensing())
    late = [0.03, 0.07, 0.02, 0.06, 0.04]
    readings = [source.send(0.1 * k + way, 100 + 0.1 * k)[0] for k, way in enumerate(late)]
    assert [r.time for r in readings[2:]] == pytest.approx([0.22, 0.32, 0.42], abs=1e-3)


def test_without_a_time_a_message_is_as_old_as_it_is_described() -> None:
    assert Sent(Sensing(delay=0.04)).send(2.0, None)[0].time == pytest.approx(1.96)


LINUX = pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells when packets arrive")


@pytest.fixture
def kernel_that_stamps():
    """Linux begins to note times of arrival some moments after the first socket asks for them; wait for that."""
    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as asking:
        stamp_arrivals(asking)
        asking.bind(("127.0.0.1", 0))
        waited = 0.0
        while waited < 0.01:
            asking.sendto(b"1", asking.getsockname())
            time.sleep(0.02)
            _, waited = receive_bytes(asking, 1)
        yield


@LINUX
def test_packets_without_a_time_are_of_when_they_came_and_not_of_when_they_are_read(
    kernel_that_stamps,
) -> None:
    port, sent = free_port(socket.SOCK_DGRAM), list[float]()
    with (
        listening(JsonLineSource(Sensing(f"udp://127.0.0.1:{port}"))) as source,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender,
    ):
        for pause in (0.35, 0.35):  # s, together less than OLDEST
            sent.append(time.monotonic())
            sender.sendto(b'{"values": [1, 2, 3]}', ("127.0.0.1", port))
            time.sleep(pause)
        looked = time.monotonic()
        found = source.take(NOWHERE, looked)
    assert len(found) == 2
    early = 0.05  # s by which two clocks of a machine may differ
    assert sent[0] - early <= found[0].time < sent[1] - early <= found[1].time < looked - early


@LINUX
def test_so_is_a_line_of_a_stream(kernel_that_stamps) -> None:
    with (
        closing(socket.create_server(("127.0.0.1", 0))) as server,
        listening(JsonLineSource(Sensing(f"tcp://127.0.0.1:{server.getsockname()[1]}"))) as source,
        closing(server.accept()[0]) as sender,
    ):
        sent = time.monotonic()
        sender.sendall(b'{"values": [1, 2, 3]}\n')
        time.sleep(0.4)
        looked = time.monotonic()
        (reading,) = source.take(NOWHERE, looked)
    assert sent - 0.05 <= reading.time < looked - 0.05


def test_what_comes_too_late_is_left_out_and_a_flood_is_cut() -> None:
    source = Sent(Sensing())
    source.send(1.0, 1.0)
    assert source.send(2.5, 2.5 - OLDEST - 0.1) == []
    assert [r.time for r in source.send(3.0, *np.linspace(2.9, 3.0, 50))] == pytest.approx(
        np.linspace(2.9, 3.0, 50)[-4:], abs=5e-3
    )


def test_messages_of_another_size_are_named() -> None:
    source = Sent(Sensing(measures="pose"))
    assert source.send(1.0, 1.0) == []
    assert source.strange == "3 numbers, where 6 are measured"


@pytest.mark.parametrize(
    "line",
    [
        b"",
        b"x",
        b"[1, 2, 3]",
        b"{}",
        b'{"values": 3}',
        b'{"values": [[1, 2, 3]]}',
        b'{"values": ["a", 2, 3]}',
        b'{"values": [1, 2, Infinity]}',
        b'{"values": [1, 2, 3], "time": "now"}',
        b'{"values": [1, 2, 3], "time": NaN}',
        b'{"values": [1, 2, 1e999]}',
        b'\xff\xfe{"values": [1]}',
        b"[" * 100000,
    ],
)
def test_lines_that_are_no_measurement_are_named(line: bytes) -> None:
    assert isinstance(message_of(line), str)


def test_what_is_missing_in_a_line_is_nan() -> None:
    found = message_of(b'{"values": [1, null, 3.5], "time": 7, "more": "words"}')
    assert isinstance(found, Message)
    assert found.stamp == 7
    assert found.values == pytest.approx([1, np.nan, 3.5], nan_ok=True)


def free_port(kind: int) -> int:
    with closing(socket.socket(socket.AF_INET, kind)) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def line(k: int) -> bytes:
    return json.dumps({"values": [k, 0.0, 1.0], "time": float(k)}).encode()


def taken(source: Remote, until: Callable[[], bool] = lambda: False, seconds: float = 5.0) -> list[Reading]:
    """What comes until something holds, or anything has come."""
    found: list[Reading] = []
    end = time.monotonic() + seconds
    while time.monotonic() < end and not (found or until()):
        time.sleep(0.01)
        found += source.take(NOWHERE, time.monotonic())
    return found


@contextmanager
def listening(source: Remote) -> Iterator[Remote]:
    source.open()
    try:
        yield source
    finally:
        source.close()


@pytest.mark.parametrize("end", [b"", b"\n"])
def test_packets_over_udp(end: bytes) -> None:
    port = free_port(socket.SOCK_DGRAM)
    with (
        listening(JsonLineSource(Sensing(f"udp://127.0.0.1:{port}"))) as source,
        closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender,
    ):
        assert source.take(NOWHERE, 0.0) == []
        sender.sendto(b"what" + end, ("127.0.0.1", port))
        sender.sendto(line(5) + end, ("127.0.0.1", port))
        (reading,) = taken(source)
        assert reading.values == pytest.approx([5, 0, 1])
        assert source.strange.startswith("b'what', which is no line as")


def test_lines_over_tcp_in_any_pieces_until_the_server_leaves() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
        with listening(JsonLineSource(Sensing(f"tcp://127.0.0.1:{port}"))) as source:
            sender, _ = server.accept()
            whole = line(1) + b"\n" + line(2) + b"\n"
            sender.sendall(whole[:20])
            time.sleep(0.05)
            assert source.take(NOWHERE, 0.0) == []
            sender.sendall(whole[20:])
            found = taken(source)
            assert [r.values[0] for r in found] == [1, 2]
            sender.close()
            assert taken(source, lambda: "closed" in source.strange) == []
            assert source.strange == "no more: the server has closed the link"
            assert source.take(NOWHERE, 0.0) == []


@pytest.mark.parametrize("kind", ["tcp", "udp"])
def test_where_nothing_can_be_listened_to_it_is_one_clear_error(kind: str) -> None:
    port = free_port(socket.SOCK_STREAM)
    host = "127.0.0.1" if kind == "tcp" else "192.0.2.1"
    with pytest.raises(DeviceFault, match=rf"the sensor at {kind}://{host}:{port} cannot be listened to"):
        JsonLineSource(Sensing(f"{kind}://{host}:{port}")).open()


class Told:
    """A client of OpenIGTLink, with what it was told."""

    def __init__(self, *messages: Any) -> None:
        self.messages = list(messages)

    def get_latest_messages(self) -> list[Any]:
        found, self.messages = self.messages, []
        return found


def igtl(sensing: Sensing, *messages: Any) -> Igtl:
    source = Igtl(sensing)
    source._client = Told(*messages)
    return source


def test_transforms_and_points_of_openigtlink() -> None:
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    frame[:3, 3] = 1, 2, 3
    pose = SimpleNamespace(device_name="Tip", matrix=frame, timestamp=5.0)
    points = SimpleNamespace(device_name="Tip", positions=[[1, 2, 3], [4, 5, 6]], timestamp=5.0)
    url = "igtl://127.0.0.1:18944/Tip"
    (reading,) = igtl(Sensing(url), pose).take(NOWHERE, 1.0)
    assert reading.values == pytest.approx([1, 2, 3])
    (reading,) = igtl(Sensing(url, "pose"), pose).take(NOWHERE, 1.0)
    assert reading.values == pytest.approx([1, 2, 3, 0.5, 0, np.sqrt(0.75)])
    (reading,) = igtl(Sensing(url, "points", (0.5, 1.0)), points).take(NOWHERE, 1.0)
    assert reading.values == pytest.approx([1, 2, 3, 4, 5, 6])
    source = igtl(Sensing(url), points)
    assert source.take(NOWHERE, 1.0) == []
    assert "which does not measure this" in source.strange
    source = igtl(Sensing("igtl://127.0.0.1:18944/Other"), pose)
    assert source.take(NOWHERE, 1.0) == []
    assert source.strange == "a message of 'Tip'"
    source._client = None  # closed
    assert source.take(NOWHERE, 1.0) == []


@pytest.mark.filterwarnings("ignore::ResourceWarning", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_an_openigtlink_server_is_listened_to() -> None:
    pyigtl = pytest.importorskip("pyigtl", reason='needs pyigtl: pip install -e ".[igtl]"')
    port = free_port(socket.SOCK_STREAM)
    server = pyigtl.OpenIGTLinkServer(port=port, local_server=True)
    try:
        with listening(Igtl(Sensing(f"igtl://127.0.0.1:{port}/Tip"))) as source:
            frame = np.eye(4)
            frame[:3, 3] = 1, 2, 3
            time.sleep(0.1)
            server.send_message(pyigtl.TransformMessage(frame, device_name="Tip"), wait=False)
            (reading,) = taken(source)
            assert reading.values == pytest.approx([1, 2, 3])
    finally:
        server.stop()
    with pytest.raises(DeviceFault, match="no OpenIGTLink server answers"):
        Igtl(Sensing(f"igtl://127.0.0.1:{free_port(socket.SOCK_STREAM)}/Tip")).open()


@pytest.mark.parametrize("measures", ["tip", "pose", "points"])
def test_poses_of_a_ros_topic(measures: str) -> None:
    pytest.importorskip("cyclonedds", reason='needs cyclonedds: pip install -e ".[ros2]"')
    from cyclonedds.pub import DataWriter
    from cyclonedds.topic import Topic as DdsTopic

    from ctr_nlp.hardware.devices.ros2.messages import parse_controller_url as ros_address
    from ctr_nlp.hardware.devices.ros2.messages import participant, quality, types
    from ctr_nlp.hardware.sensing.ros2 import Topic, geometry

    name = f"sensed_{measures}?domain={120 + os.getpid() % 80}"
    places = (0.5, 1.0) if measures == "points" else ()
    known, header = geometry(), types().Header(types().Time(3, 500_000_000), "base")
    turn = Rotation.from_euler("y", 30, degrees=True).as_quat().tolist()
    pose = known.Pose(known.Point(0.001, 0.002, 0.06), known.Quaternion(*turn))
    kind = known.PoseArray if measures == "points" else known.PoseStamped
    own, _domain = participant(ros_address(name))
    writer = DataWriter(own, DdsTopic(own, f"rt/sensed_{measures}", kind), quality(True, 1))
    with listening(Topic(Sensing(f"ros2://{name}", measures, places))) as source:

        def sent() -> bool:
            writer.write(kind(header, [pose, pose] if measures == "points" else pose))
            return False

        reading = taken(source, sent)[0]
    wanted = {"tip": [1, 2, 60], "pose": [1, 2, 60, 0.5, 0, np.sqrt(0.75)], "points": [1, 2, 60] * 2}
    assert reading.values == pytest.approx(wanted[measures])
