"""Live views: what arrives, what windows show, and that no window can disturb the work."""

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib.util import find_spec
from pathlib import Path

import frames as tracking
import numpy as np
import pytest
from bench import homing_hardware, plan_of, sweep
from lumens import straight
from matplotlib.figure import Figure
from window_backend import CLOSE, Written

from ctr_nlp import solve_horizon, table_i_robot
from ctr_nlp.cli.commands import plan as horizon_program
from ctr_nlp.cli.commands import play
from ctr_nlp.cli.live_views import PlaybackView, SolverView
from ctr_nlp.exceptions import OptionError
from ctr_nlp.hardware.description import simulated_hardware
from ctr_nlp.hardware.devices import MotionProgress
from ctr_nlp.hardware.playing.session import prepare_trajectory
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.plan.simulation import shapes
from ctr_nlp.view.figures.live import LiveWindow, PlaybackPicture, PlaybackState, SolverPicture, SolverState
from ctr_nlp.view.figures.live.pictures import ShapeContinuation
from ctr_nlp.view.figures.parts.palette import TUBE_COLOURS

pytestmark = pytest.mark.real_time

PLAN = sweep(10)
TESTS = Path(__file__).parents[2]
SECONDS = 60
"""After which something that has not happened never will."""


@pytest.fixture
def backend(monkeypatch):
    """Windows open on the backend of the tests."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setenv("MPLBACKEND", "module://window_backend")


@pytest.fixture
def written(backend, tmp_path):
    """A picture that writes, whose window is gone at the end of the test."""
    yield Written(tmp_path / "states")
    if (tmp_path / "states").exists() and alive(process(tmp_path / "states")):
        os.kill(process(tmp_path / "states"), signal.SIGTERM)


def lines(path):
    return path.read_text().split()


def process(path):
    return int(lines(path)[0])


def alive(number):
    """Whether a process runs; a child that has ended is collected."""
    try:
        return os.waitpid(number, os.WNOHANG) == (0, 0)
    except ChildProcessError:
        return False


def until(happened):
    end = time.monotonic() + SECONDS
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.02)


# Windows


def test_the_newest_state_arrives_and_the_window_outlives_the_work(written):
    with LiveWindow(written) as view:
        for k in range(1000):
            view.show(lambda k=k: k)
    until(lambda: lines(written.path)[-1] == "999")
    assert len(lines(written.path)) < 900
    assert alive(process(written.path))
    assert os.getsid(process(written.path)) == process(written.path)  # Ctrl-C goes to the program alone


def test_states_arrive_while_the_work_goes_on(written):
    with LiveWindow(written) as view:
        for k in range(3):
            view.show(lambda k=k: k)
            until(lambda k=k: lines(written.path)[-1] == str(k))


def test_a_closed_window_does_not_disturb(written):
    called = []
    with LiveWindow(written) as view:
        view.show(lambda: CLOSE)
        until(lambda: not alive(process(written.path)))
        for k in range(100):
            view.show(lambda k=k: called.append(k))
            time.sleep(0.002)
    assert lines(written.path)[1:] == [CLOSE]


def program(written, *work):
    """The command of a program that opens a window and then works."""
    lines = [
        "import os, signal, time",
        "from pathlib import Path",
        "from window_backend import Written",
        "from ctr_nlp.view.figures.live import LiveWindow",
        f"path = Path({str(written.path)!r})",
        "with LiveWindow(Written(path)) as view:",
        *(f"    {line}" for line in work),
        "print('done')",
    ]
    return [sys.executable, "-c", "\n".join(lines)]


def test_no_one_who_reads_a_programs_output_waits_for_its_window(written):
    command = program(written, "view.show(lambda: 'last')")
    ended = subprocess.run(command, capture_output=True, text=True, timeout=SECONDS)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "done\n", "")
    number = process(written.path)
    os.kill(number, 0)
    os.kill(number, signal.SIGTERM)


@pytest.mark.skipif(not hasattr(signal, "SIGSTOP"), reason="processes cannot be stopped on this system")
def test_a_window_that_hangs_holds_nothing_up(written, tmp_path):
    """States are larger than any buffer on the way; what shows them must return, and the program end."""
    command = program(
        written,
        "os.kill(int(path.read_text()), signal.SIGSTOP)",
        "for _ in range(5):",
        "    view.show(lambda: bytes(10**7))",
        "    time.sleep(0.1)",
    )
    with open(tmp_path / "said", "w") as said:
        work = subprocess.Popen(command, stdout=said, stderr=said)
    try:
        assert work.wait(SECONDS) == 0
        assert (tmp_path / "said").read_text() == "done\n"
    finally:
        work.kill()
        os.kill(process(written.path), signal.SIGKILL)


def test_a_failure_of_the_work_closes_the_window(written):
    with pytest.raises(ZeroDivisionError), LiveWindow(written):
        raise ZeroDivisionError
    assert not alive(process(written.path))


def test_without_a_display_there_is_one_clear_error(monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "agg")
    with pytest.raises(OptionError, match=r"no display.*backend is agg.*tkinter.*ssh -X.*MPLBACKEND=WebAgg"):
        LiveWindow(PlaybackPicture(PLAN))


def test_programs_refuse_before_anything_moves_or_is_solved(monkeypatch, tmp_path, capsys):
    monkeypatch.setenv("MPLBACKEND", "agg")
    begun = "ctr_nlp.planning.horizon.horizon_planner"
    monkeypatch.setattr(begun, lambda *_, **__: pytest.fail("solving was begun"))
    monkeypatch.setattr(play, "device_of", lambda *_: pytest.fail("a device was opened"))
    PLAN.save(tmp_path / "plan.npz")
    out = ["--live", "--out", str(tmp_path / "out")]
    assert horizon_program.plan(["arc", *out]) == 2
    assert play.main([str(tmp_path / "plan.npz"), "--uncertified", *out]) == 2
    assert capsys.readouterr().err.count("error: live needs a window") == 2
    assert not (tmp_path / "out").exists()


def test_a_dry_run_has_nothing_to_show(capsys):
    assert play.main(["plan.npz", "--live", "--dry-run"]) == 2
    assert "--live does not go with --dry-run" in capsys.readouterr().err


# What is told of


class FakeView:
    """Keeps every state."""

    def __init__(self):
        self.states = []

    def show(self, state):
        self.states.append(state())


@pytest.mark.parametrize("time", [0.0, 0.37])
def test_a_player_tells_where_the_robot_is_and_should_be(time):
    """Axes that are off by some of their units are joints that are off by as much; play in drives is no error."""
    hardware = simulated_hardware(PLAN.robot)
    axes = tuple(dataclasses.replace(axis, backlash=0.3, zero=1.0) for axis in hardware.axes)
    hardware = dataclasses.replace(hardware, axes=axes)
    program = prepare_trajectory(PLAN, hardware)[0]
    off = np.array([0.2 if axis.joint == "beta_2" else 0.0 for axis in hardware.axes])
    positions = program.positions(np.array([time]))[0] + off
    view = FakeView()
    played = PlaybackView(view)
    played.show_outcome("nothing was seen")
    played(program, MotionProgress("running", time, positions, 0.0, 0.0), "running")
    played.show_outcome("success")
    first, last = view.states
    np.testing.assert_allclose(first.commanded, program.at(np.array([time]))[0][0])
    np.testing.assert_allclose(first.measured - first.commanded, [0, 0, 0, 0, 0.2, 0, 0, 0], atol=1e-9)
    passed = program.frames[program.frame_time <= time][-1]
    assert (first.state, first.frame, first.time) == ("running", passed, time)
    assert (last.state, last.frame) == ("success", passed)


def test_positions_become_joints_on_any_hardware():
    """Axes with signs, zeros and units of their own."""
    program = prepare_trajectory(PLAN, homing_hardware())[0]
    time = program.frame_time
    np.testing.assert_allclose(program.joints(time, program.positions(time)), program.at(time)[0], atol=1e-9)


def test_what_a_robot_passes_before_its_first_frame_is_no_frame():
    assert prepare_trajectory(PLAN, simulated_hardware(PLAN.robot))[0].last_frame_passed(-0.1) == 0


def test_every_iterate_is_told_of_and_the_last_is_the_plan(arc_problem):
    told = []
    plan = solve_horizon(arc_problem, model="dominant", starts=1, callback=told.append)
    assert [iterate.number for iterate in told] == list(range(len(told)))
    assert told[-1].objective == pytest.approx(plan.objective.sum())
    view = FakeView()
    solved = SolverView(view, arc_problem)
    for iterate in told[-2:]:
        solved(iterate)
    solved(told[0])
    solved.show_plan(plan)
    np.testing.assert_allclose(view.states[1].motion, plan.q, atol=1e-6)
    np.testing.assert_allclose(view.states[1].objective, [each.objective / 4 for each in told[-2:]])
    np.testing.assert_allclose(view.states[2].error, [told[-2].error, told[-1].error, np.nan, told[0].error])
    assert view.states[3] is plan


def test_of_several_processes_each_better_motion_is_told_of(arc_problem):
    told = []
    plan = solve_horizon(arc_problem, model="dominant", starts=3, jobs=2, callback=told.append)
    objectives = [iterate.objective for iterate in told]
    assert 1 <= len(told) <= 3
    assert objectives == sorted(objectives, reverse=True)
    np.testing.assert_array_equal(told[-1].x.reshape(4, -1), plan.q)
    assert told[-1].error == pytest.approx(plan.kkt.max(), abs=1e-5)


# Pictures


def lines_of(figure, wanted):
    """Points (n, 3) of the lines in space that are wanted."""
    found = [line for line in figure.axes[0].lines if wanted(line) and len(line.get_data_3d()[0])]
    return [np.array(line.get_data_3d()).T for line in found]


def words(figure):
    return " / ".join(text.get_text() for text in figure.texts)


def test_a_robot_is_drawn_where_it_is_and_where_it_should_be():
    robot, figure = PLAN.robot, Figure(figsize=PlaybackPicture.size)
    picture = PlaybackPicture(dataclasses.replace(PLAN, lumen=Lumen.from_curve(straight(8.0)).table))
    picture.begin(figure)
    assert "waiting" in words(figure)
    picture.show(PlaybackState("hold", 4, 0.4, PLAN.q[5], PLAN.q[3]))
    figure.draw_without_rendering()
    measured = lines_of(figure, lambda line: line.get_color() in TUBE_COLOURS and 1 < line.get_lw() < 5)
    commanded = lines_of(figure, lambda line: line.get_lw() > 5)
    np.testing.assert_allclose(measured[-1][-1], shapes(robot, PLAN.q[5:6])[0, -1])
    np.testing.assert_allclose(commanded[-1][-1], shapes(robot, PLAN.q[3:4])[0, -1])
    (target,) = lines_of(figure, lambda line: line.is_dashed())
    np.testing.assert_allclose(target, PLAN.target[3])
    assert "hold, frame 4 of 10, 0.4 s" in words(figure)
    (wall,) = lines_of(figure, lambda line: line.get_color() == "0.72")
    np.testing.assert_allclose(np.hypot(*wall[np.isfinite(wall[:, 0]), :2].T), 8.0)


def test_equilibria_are_followed_from_moment_to_moment():
    """Tubes that are turned against each other: settled alone, a later moment would be elsewhere."""
    robot, turned = table_i_robot(), np.linspace(0.0, 4.0, 9)
    q = np.array([[angle, 0, -angle, 10, 60, 80, 0, 0] for angle in turned])
    followed = tracking.elastic_shapes(robot, tracking.follow(robot, q).x)
    shape = ShapeContinuation(robot, "elastic")
    np.testing.assert_allclose([shape(each) for each in q], followed, atol=1e-9)
    assert np.isnan(shape(np.full(8, np.nan))).all()
    assert np.isfinite(shape(q[0])).all()


def test_a_motion_is_drawn_while_it_is_solved_for():
    plan = sweep(5)
    figure = Figure(figsize=SolverPicture.size)
    picture = SolverPicture("bench", plan.robot, "dominant", plan.target, None)
    picture.begin(figure)
    objective, error = np.array([3.0, 2.0, np.nan, 1.0]), np.array([1.0, 0.1, np.nan, 0.0])
    picture.show(SolverState(objective, error, plan.q))
    figure.draw_without_rendering()
    tips = [line[-1] for line in lines_of(figure, lambda line: line.get_color() == TUBE_COLOURS[2])]
    np.testing.assert_allclose(tips, plan.shape[:, -1])
    upper, lower = figure.axes[1:]
    assert (upper.get_yscale(), upper.get_ylabel()) == ("log", "objective (mm²)")
    assert (lower.get_yscale(), lower.get_ylabel()) == ("log", "KKT residual")
    np.testing.assert_array_equal(upper.lines[0].get_ydata(), objective)
    assert upper.get_ylim()[0] <= 1.0
    assert upper.get_ylim()[1] >= 3.0
    assert "objective 1 mm²" in words(figure)


def test_at_last_the_plan_is_drawn(arc_problem):
    plan = solve_horizon(arc_problem, model="dominant", starts=1)
    figure = Figure(figsize=SolverPicture.size)
    picture = SolverPicture("arc", plan.robot, "dominant", plan.target, None)
    picture.begin(figure)
    picture.show(plan)
    tips = [line[-1] for line in lines_of(figure, lambda line: line.get_color() == TUBE_COLOURS[2])]
    np.testing.assert_allclose(tips, plan.shape[:, -1])
    assert "the plan: e3 = " in words(figure)


def test_a_motion_on_the_elastic_model_is_drawn_by_its_own_unknowns():
    robot = table_i_robot()
    q = np.array([[0.5, 0.0, -0.5, 10, 60, 80, 0, 0], [1.0, 0.0, -1.0, 12, 62, 82, 0, 0]])
    x = tracking.follow(robot, q).x
    figure = Figure(figsize=SolverPicture.size)
    picture = SolverPicture("pair", robot, "elastic", plan_of(q, 0.1).target, None)
    picture.begin(figure)
    picture.show(SolverState(np.ones(1), np.ones(1), x))
    tips = [line[-1] for line in lines_of(figure, lambda line: line.get_color() == TUBE_COLOURS[2])]
    np.testing.assert_allclose(tips, tracking.elastic_shapes(robot, x)[:, -1])


# On a display


@pytest.fixture
def display(tmp_path, monkeypatch):
    """A screen in memory; yields the file of its pixels."""
    if shutil.which("Xvfb") is None or find_spec("tkinter") is None:
        pytest.skip("Xvfb or tkinter is not installed")
    read, write = os.pipe()
    server = subprocess.Popen(
        ["Xvfb", "-displayfd", str(write), "-screen", "0", "1024x768x24", "-fbdir", str(tmp_path)],
        pass_fds=(write,),
        stderr=subprocess.DEVNULL,
    )
    os.close(write)
    with open(read) as told:
        monkeypatch.setenv("DISPLAY", f":{told.readline().strip()}")
    monkeypatch.setenv("MPLBACKEND", "TkAgg")
    yield tmp_path / "Xvfb_screen0"
    server.kill()
    server.wait()


def drawn(screen, colour):
    """Pixels of a colour on a screen."""
    red, green, blue = bytes.fromhex(colour[1:])
    return screen.read_bytes().count(bytes([blue, green, red]))


def test_a_window_shows_a_plan_that_is_played(display, tmp_path, capsys):
    PLAN.save(tmp_path / "plan.npz")
    before = drawn(display, TUBE_COLOURS[0])
    assert play.main([str(tmp_path / "plan.npz"), "--uncertified", "--live", "--out", str(tmp_path / "out")]) == 0
    assert "frame 10 reached" in capsys.readouterr().out
    until(lambda: drawn(display, TUBE_COLOURS[0]) > before + 100)
