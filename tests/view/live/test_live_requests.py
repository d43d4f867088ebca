"""Whose requests the server of the live page answers, and what it says of messages that make no sense."""

import http.client
import logging
import socket

import pytest
from common import named_problem

pytest.importorskip("viser", reason='needs viser: pip install "ctr_nlp[live]"')
import msgspec
import viser
from test_live_page import asked, until
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from ctr_nlp import table_i_robot
from ctr_nlp.view.live import Live

PROTOCOL = Subprotocol(f"viser-v{viser.__version__}")


@pytest.fixture(scope="module")
def live():
    served = Live(named_problem("arc", 20), model="dominant", port=0, robots={"Table I": table_i_robot()})
    yield served
    served.stop()


@pytest.fixture
def port(live):
    return int(live.url.rpartition(":")[2])


def opened(port, origin=None, **more):
    return connect(f"ws://127.0.0.1:{port}", origin=origin, subprotocols=[PROTOCOL], **more)


def status(port, *headers):
    """Of a request for the page with these headers, of which Host may be any number."""
    link = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
    link.putrequest("GET", "/", skip_host=True)
    for name, value in headers:
        link.putheader(name, value.format(port=port))
    link.endheaders()
    found = link.getresponse()
    found.read()
    link.close()
    return found.status


def lines(caplog):
    return [record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING]


@pytest.mark.parametrize(
    "origin", ["http://example.com", "http://127.0.0.1:1", "https://127.0.0.1:{port}", "null", "http://127.0.0.1"]
)
def test_a_socket_of_another_page_is_refused(port, origin):
    with pytest.raises(InvalidStatus) as refused, opened(port, origin.format(port=port)):
        pass
    assert refused.value.response.status_code == 403


def test_sockets_of_its_own_page_and_of_programs_are_accepted(port):
    for origin in (f"http://127.0.0.1:{port}", f"http://localhost:{port}", None):
        with opened(port, origin) as link:
            assert isinstance(link.recv(timeout=30), bytes)


def test_a_socket_for_another_host_is_refused(port):
    with (
        pytest.raises(InvalidStatus) as refused,
        socket.create_connection(("127.0.0.1", port)) as link,
        connect(f"ws://example.com:{port}", sock=link, subprotocols=[PROTOCOL]),
    ):
        pass
    assert refused.value.response.status_code == 403


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        ([("Host", "127.0.0.1:{port}")], 200),
        ([("Host", "LOCALHOST:{port}")], 200),
        ([("Host", "127.0.0.1:{port}"), ("Origin", "http://localhost:{port}")], 200),
        ([("Host", "127.0.0.1:{port}"), ("Origin", "http://example.com")], 403),
        ([("Host", "example.com:{port}")], 403),
        ([("Host", "127.0.0.1")], 403),
        ([("Host", "127.0.0.1:1")], 403),
        ([("Host", "127.0.0.1:{port}"), ("Host", "example.com")], 403),
        ([], 403),
    ],
)
def test_the_page_is_only_served_under_its_own_name(port, headers, expected):
    assert status(port, *headers) == expected


@pytest.mark.parametrize(
    "message",
    [b"\xff\xff", b"", msgspec.msgpack.encode({"type": "NoSuchMessage"}), msgspec.msgpack.encode([1]), "text"],
)
def test_a_message_without_meaning_leaves_one_line(live, port, caplog, capfd, message):
    with opened(port) as link:
        link.send(message)
        until(lambda: lines(caplog))
    begins = "a message to the live page could not be read: "
    assert [line.startswith(begins) for line in lines(caplog)] == [True]
    assert "Traceback" not in caplog.text + "".join(capfd.readouterr())
    assert asked(live, lambda session: session.problem.robot) is not None


def test_a_drag_to_no_point_leaves_one_line_and_drags_nothing(live, port, caplog, capfd):
    ball = live._scene._handles[-1]
    before = asked(live, lambda session: session.goal.handles.copy())
    drag = {
        "type": "SceneNodeDragMessage",
        "name": ball._impl.name,
        "phase": "start",
        "button": "left",
        "modifiers": [],
        "instance_index": None,
        "start_position": ["a", 0],
        "end_position": [0.0],
        "screen_pos": [0.0, 0.0],
        "ray_origin": [0.0, 0.0, 0.0],
        "ray_direction": [0.0, 0.0, 1.0],
    }
    with opened(port) as link:
        link.recv(timeout=30)
        link.send(msgspec.msgpack.encode(drag))
        until(lambda: lines(caplog))
    assert len(lines(caplog)) == 1
    assert "Traceback" not in caplog.text + "".join(capfd.readouterr())
    assert (asked(live, lambda session: session.goal.handles.copy()) == before).all()


def test_a_robot_that_is_not_offered_is_told_and_changes_nothing(live):
    live.use_robot("unknown")
    until(lambda: "unknown" in live._news)
    assert asked(live, lambda session: session.problem.name) == "arc"
