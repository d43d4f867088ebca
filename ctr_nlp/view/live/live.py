"""Live steering served to browsers: a session that is moved thirty times a second, its scene and its panel."""

from __future__ import annotations

import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from ctr_nlp.exceptions import CtrError, OptionError
from ctr_nlp.models import DEFAULT_MODEL
from ctr_nlp.models.loads import Load
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.plan.plan import Plan
from ctr_nlp.planning.nlp_frames import DEFAULT_PLANNER_SETTINGS
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import check_choice, check_instance
from ctr_nlp.view.live.page.messages import status_message, verdict_list
from ctr_nlp.view.live.page.panel import ControlPanel
from ctr_nlp.view.live.page.scene import Scene
from ctr_nlp.view.live.page.server import HOST, PORT, start_server, stop_server
from ctr_nlp.view.live.steered.drive import suitable_models
from ctr_nlp.view.live.steered.recording import Recording
from ctr_nlp.view.live.steered.session import Session, SessionState

PROBLEM_ROBOT_LABEL = "the problem's own"
"""The name of the robot that the problem comes with."""
NOTEBOOK_FRAME_HEIGHT_PX = 640
"""Pixels of the frame in a notebook."""
WAIT_POLL_S = 0.05
"""s between two looks at whether waiting has ended."""
TIMED_STEP_COUNT = 60
"""Steps over which it is told what part of the time they take."""
SNAP_NOTICE_S = 4.0
"""s for which it is told that the robot snapped."""


class Live:
    """A page on which a problem's robot is steered, served from construction until stop().

    url: where the page is. plan: the last motion that was recorded; None before the first.
    """

    def __init__(
        self,
        problem: Problem,
        model: str = DEFAULT_MODEL,
        settings: Settings = DEFAULT_PLANNER_SETTINGS,
        robots: Mapping[str, Robot] | None = None,
        host: str = HOST,
        port: int = PORT,
        save_plan: Callable[[Plan], str] | None = None,
        load: Load | None = None,
    ) -> None:
        """Serve; raises OptionError where a port is in use, nothing can be compiled, or viser is not installed.

        robots: others to choose from, by name. host, port: where; port 0 takes any that is free. save_plan: what
        is done with a recorded plan, in a thread of its own; what it returns tells where the plan went. load: what
        the robot bears, on the elastic model. Raises as Session, too.
        """
        check_instance(OptionError, "problem", problem, Problem)
        self.plan: Plan | None = None
        self._problem = problem
        self._settings = settings
        self._keep = save_plan
        self._robots = {PROBLEM_ROBOT_LABEL: problem.robot, **(robots or {})}
        self._inbox: queue.SimpleQueue[Callable[[], None]] = queue.SimpleQueue()
        self._spent: deque[float] = deque(maxlen=TIMED_STEP_COUNT)
        self._news = ""
        self._snapped = -SNAP_NOTICE_S
        self._course = 0.0
        self._writing: threading.Thread | None = None
        self._ending = threading.Event()
        self._failures = list[Exception]()
        self._session = Session(problem, model, settings, load=load)
        self._server = start_server(host, port)
        self.url = f"http://{host}:{self._server.get_port()}"
        self._build_page(PROBLEM_ROBOT_LABEL)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def show(self, height: int = NOTEBOOK_FRAME_HEIGHT_PX) -> Any:
        """The page within a notebook, as an IFrame so many pixels high; raises OptionError outside of IPython."""
        try:
            from IPython.display import IFrame
        except ImportError as error:
            raise OptionError(f"show() is for notebooks, and IPython is not installed; open {self.url}") from error
        return IFrame(self.url, width="100%", height=height)

    def wait(self, ended: Callable[[], bool]) -> None:
        """Serve until ended() is true, in the main thread; raises what has made steering fail."""
        while not ended() and self._thread.is_alive():
            time.sleep(WAIT_POLL_S)
        self.stop()

    def stop(self) -> None:
        """End serving; a plan that is being kept is kept first. Raises what has made steering fail."""
        self._ending.set()
        self._thread.join()
        if self._writing is not None:
            self._writing.join()
        stop_server(self._server)
        if self._failures:
            raise self._failures[0]

    # What the panel and the scene ask for, in any thread: panel.Asked

    def ask(self, act: Callable[[Session], None]) -> None:
        """Do something to the session between two steps."""
        self._inbox.put(lambda: act(self._session))

    def play(self, on: bool) -> None:
        """Follow the path to its end and back, again and again, or stop that."""
        self._inbox.put(lambda: self._set_off(on))

    def use_robot(self, name: str) -> None:
        """Go on with another robot from the beginning of the path."""
        self._inbox.put(lambda: self._replace(name))

    def record(self) -> None:
        """Begin to record, or end it and keep the plan."""
        self._inbox.put(self._record)

    # The loop

    def _run(self) -> None:
        """Step after step, each begun when it is due; one that is late is not made up for."""
        try:
            due = time.perf_counter()
            while not self._ending.is_set():
                begin = time.perf_counter()
                self._answer()
                self._show(self._step())
                self._spent.append(time.perf_counter() - begin)
                due = max(due + self._session.dt, time.perf_counter())
                self._ending.wait(due - time.perf_counter())
        except Exception as error:
            self._failures.append(error)

    def _answer(self) -> None:
        """Do what was asked for since the last step; what cannot be done is told, and changes nothing."""
        while not self._inbox.empty():
            try:
                self._inbox.get()()
            except CtrError as error:
                self._news = f"{error}."

    def _step(self) -> SessionState:
        session = self._session
        if self._course:
            progress = session.goal.progress + self._course * session.dt / session.problem.duration
            self._course *= 1.0 if 0.0 < progress < 1.0 else -1.0
            session.goal.advance(min(max(progress, 0.0), 1.0))
        seen = session.step()
        if seen.snapped:
            self._snapped = time.monotonic()
        return seen

    def _show(self, seen: SessionState) -> None:
        session = self._session
        busy = sum(self._spent) / max(len(self._spent), 1) / self._session.dt
        snapped = time.monotonic() - self._snapped < SNAP_NOTICE_S
        with self._server.atomic():
            self._scene.show(seen, session.goal.handles, self._panel.colour_quantity)
            self._panel.show(seen, bool(self._course), status_message(session, snapped, self._news), busy)
        self._server.flush()

    def _build_page(self, robot: str) -> None:
        """Draw the session anew, which has this robot."""
        self._scene = Scene(self._server, self._session.problem, self._pull_handle)
        self._panel = ControlPanel(self._server.gui, self._session, tuple(self._robots), robot, self)

    def _pull_handle(self, handle: int, point: Any) -> None:
        self.ask(lambda session: session.pull(handle, point))

    def _set_off(self, on: bool) -> None:
        self._course = (1.0 if self._session.goal.progress < 1.0 else -1.0) if on else 0.0

    def _replace(self, name: str) -> None:
        check_choice("robot", name, self._robots)
        problem = replace(self._problem, robot=self._robots[name])
        load = self._session.load
        models = suitable_models(problem, load)
        if not models:
            borne = "" if load is None else ", which would have to bear a load"
            raise OptionError(f"no model describes the robot {name!r}{borne}")
        before = self._session
        self._course = 0.0
        model = before.requested_model if before.requested_model in models else models[0]
        self._session = Session(problem, model, self._settings, load=load)
        self._panel.remove()
        self._server.scene.reset()
        self._build_page(name)

    def _record(self) -> None:
        if self._session.moment_count is None:
            self._session.record()
            self._news = "Everything that the robot does is recorded."
        else:
            self._writing = threading.Thread(target=self._finish_recording, args=(self._session.end_recording(),))
            self._writing.start()
            self._news = "The plan is being made of what was recorded."

    def _finish_recording(self, recording: Recording) -> None:
        """Make a plan and keep it, beside the steps that go on."""
        try:
            plan = recording.plan().check()
            self.plan = plan
            told = "It is this object's `plan`" if self._keep is None else self._keep(plan)
            self._news = f"The plan of {len(plan.time)} frames was made. {told}.\n\n{verdict_list(plan)}"
        except CtrError as error:
            self._news = f"{error}."
