"""The page of live steering in a real browser, and the command that serves it."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request

import numpy as np
import pytest
from browser import SOFTWARE, launcher
from common import ROOT, named_problem

from ctr_nlp import Plan, table_i_robot
from ctr_nlp.cli.main import COMMANDS, load
from ctr_nlp.exceptions import OptionError
from ctr_nlp.view.live import Live

pytest.importorskip("viser", reason='needs viser: pip install "ctr_nlp[live]"')
PATIENCE = 60.0
"""s after which a busy machine is given up."""


def pixel(camera, box, point):
    """Where a point (3,) mm is on a canvas, for the camera that a scene begins with."""
    eye, up = np.array(camera.position), np.array(camera.up)
    ahead = np.array(camera.look_at) - eye
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, up) / np.linalg.norm(np.cross(ahead, up))
    away, scale = point - eye, box["height"] / 2 / np.tan(camera.fov / 2)
    x, y = scale * (away @ right) / (away @ ahead), scale * (away @ np.cross(right, ahead)) / (away @ ahead)
    return box["x"] + box["width"] / 2 + x, box["y"] + box["height"] / 2 - y


def until(true):
    """Wait until something is true."""
    end = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < end, "it never came true"
        time.sleep(0.05)


def asked(live, question):
    """The answer of a live session to a question, between two of its steps."""
    answers = []
    live.ask(lambda session: answers.append(question(session)))
    until(lambda: answers)
    return answers[0]


@pytest.fixture
def live():
    served = Live(named_problem("arc", 20), model="dominant", port=0, robots={"Table I": table_i_robot()})
    yield served
    served.stop()


def test_a_recording_that_is_being_saved_when_the_next_one_ends_is_saved(monkeypatch):
    served = Live(named_problem("arc", 20), model="dominant", port=0)
    saved, first_may_end = [], threading.Event()

    def save(recording):
        if not begun:
            begun.append(recording)
            first_may_end.wait(PATIENCE)
        saved.append(recording)

    begun = []
    monkeypatch.setattr(served, "_finish_recording", save)
    for _ in range(2):
        served.record()
        until(lambda: asked(served, lambda session: session.moment_count) is not None)
        served.record()
        until(lambda: asked(served, lambda session: session.moment_count) is None)
    until(lambda: len(saved) == 1)
    stopping = threading.Thread(target=served.stop)
    stopping.start()
    stopping.join(0.5)
    assert stopping.is_alive()  # it waits for the first one
    first_may_end.set()
    stopping.join(PATIENCE)
    assert len(saved) == 2


@pytest.mark.real_time
def test_a_tip_is_dragged_in_the_browser_and_the_motion_recorded(live):
    live.ask(lambda session: session.goal.advance(1.0))
    before = asked(live, lambda session: session.goal.handles[-1].copy())
    with launcher() as launch:
        browser = launch(SOFTWARE)
        page, fetched = browser.new_page(viewport={"width": 900, "height": 640}), []
        page.set_default_timeout(1e3 * PATIENCE)
        page.on("request", lambda request: fetched.append(request.url))
        page.goto(live.url)
        page.get_by_text("shape error e2").wait_for()
        for close in page.locator(".mantine-Notification-closeButton").all():  # software rendering is told of
            close.click()
        page.get_by_role("button", name="Record", exact=True).click()
        box = page.locator("canvas").first.bounding_box()
        x, y = pixel(live._server.initial_camera, box, before)
        page.mouse.move(x, y)
        page.wait_for_timeout(500)
        page.mouse.down()
        for part in np.linspace(0.2, 1.0, 5):
            page.mouse.move(x + 40 * part, y - 20 * part)
            page.wait_for_timeout(100)
        page.mouse.up()
        until(lambda: asked(live, lambda session: session.goal.is_displaced))
        until(lambda: np.hypot(*np.subtract(_shown(live, box), (x + 40, y - 20))) < 5.0)
        page.get_by_role("button", name=re.compile("Stop, and keep")).click()
        page.get_by_text(re.compile("The plan of .* frames was made")).wait_for()
        browser.close()
    until(lambda: live._report)
    with urllib.request.urlopen(f"{live.url}/report", timeout=PATIENCE) as answer:
        assert answer.headers.get_content_type() == "text/html"
        assert "recorded live" in answer.read().decode()
    live.play_recording()
    until(lambda: asked(live, lambda session: session.is_playing_back))
    assert isinstance(live.plan, Plan)
    assert np.linalg.norm(live.plan.target[-1, -1] - before) > 5.0
    assert fetched
    assert {url.removeprefix("blob:").startswith(f"{live.url}/") for url in fetched} == {True}


def _shown(live, box):
    """Where the tip's handle is on the canvas."""
    return pixel(live._server.initial_camera, box, asked(live, lambda session: session.goal.handles[-1].copy()))


def test_another_robot_begins_anew_and_what_cannot_be_done_is_told(live):
    live.ask(lambda session: session.goal.advance(2.0))
    live.use_robot("Table I")
    until(lambda: asked(live, lambda session: session.problem.robot) == table_i_robot())
    assert asked(live, lambda session: session.goal.progress) == 0.0
    assert "progress is 2" in live._news


def test_before_a_recording_there_is_neither_report_nor_playback(live):
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{live.url}/report", timeout=PATIENCE)
    live.play_recording()
    until(lambda: "nothing was recorded yet" in live._news)


def test_a_page_within_a_notebook_is_that_of_the_server(live):
    pytest.importorskip("IPython")
    frame = live.show(height=300)
    assert (frame.src, frame.height) == (live.url, 300)


def test_a_port_in_use_is_one_clear_line(capsys, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(OptionError, match=rf"port {port} of 127.0.0.1 .* in use.*give another"):
            Live(named_problem("arc", 5), model="dominant", port=port)
        assert load(COMMANDS["live"])(["arc", "--port", str(port), "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.startswith(f"error: port {port} of 127.0.0.1") for line in lines] == [True]
    assert not (tmp_path / "out").exists()


def test_a_problem_of_any_name_is_shown_as_text(tmp_path):
    name = "airway [/left] [red]\x1b[2J\n../../x </script> $\\frac{$ 'a\"b\u202e"
    (tmp_path / "mine.py").write_text(
        "from dataclasses import replace\n\nfrom ctr_nlp.problems import named_problem\n\n\n"
        "def problem(frames, duration, robot):\n"
        f"    return replace(named_problem('arc', frames, duration, robot), name={name!a})\n"
    )
    command = [sys.executable, "-m", "ctr_nlp", "live", "mine.py", "--port", "0", "--out", "out"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = os.environ | {"PYTHONUNBUFFERED": "1", "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, cwd=tmp_path, env=environment, **pipes)
    told = process.stdout.readline()
    address = re.search(r"http://127\.0\.0\.1:\d+", told)[0]
    with urllib.request.urlopen(address, timeout=PATIENCE) as answer:
        page = answer.read().decode()
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "[red]" in told
    assert all(line.isprintable() for line in (told + out + error).splitlines())
    assert "Traceback" not in error
    assert "x </script>" not in page
    assert {path.name for path in tmp_path.iterdir()} <= {"mine.py", "__pycache__"}


def test_ctrl_c_ends_the_command_with_130(tmp_path):
    command = [sys.executable, "-m", "ctr_nlp", "live", "arc", "--port", "0", "--out", str(tmp_path / "out")]
    process = subprocess.Popen(
        command, cwd=ROOT, env=os.environ | {"PYTHONUNBUFFERED": "1"}, stdout=subprocess.PIPE, text=True
    )
    assert re.match(r"steer arc at http://127\.0\.0\.1:\d+; Ctrl-C ends it", process.stdout.readline())
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert not (tmp_path / "out").exists()


def test_with_json_the_address_is_told_at_once_and_the_object_at_the_end(tmp_path):
    command = [
        sys.executable,
        "-m",
        "ctr_nlp",
        "live",
        "arc",
        "--port",
        "0",
        "--json",
        "--out",
        str(tmp_path / "out"),
    ]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen(command, cwd=ROOT, env=os.environ | {"PYTHONUNBUFFERED": "1"}, **pipes)
    line = next(line for line in process.stderr if line.startswith("steer arc at http://127.0.0.1:"))
    process.send_signal(signal.SIGINT)
    told, _ = process.communicate(timeout=PATIENCE)
    assert line.strip() in json.loads(told)["lines"]


@pytest.mark.parametrize("width", [390, *(pytest.param(width, marks=pytest.mark.slow) for width in (768, 1440))])
def test_the_page_fits_the_screen_and_axe_finds_no_fault(live, width):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-core")
    with launcher() as launch:
        page = launch(SOFTWARE).new_page(viewport={"width": width, "height": 900})
        page.set_default_timeout(1e3 * PATIENCE)
        page.goto(live.url)
        page.get_by_text("shape error e2").first.wait_for(state="attached")
        page.locator("h1").wait_for(state="attached")
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        violations = axe.Axe().run(page).response["violations"]
    assert [f"{each['id']}: {each['nodes'][0]['html'][:200]}" for each in violations] == []
