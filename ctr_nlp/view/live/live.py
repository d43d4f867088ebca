"""Live steering served to browsers: a session that is moved thirty times a second, its scene and its panel.

Three kinds of threads: the server's call what people do on the page; the steering thread alone changes session
and scene; a thread for each recording makes and saves its plan. Requests go from the first to the second
through one queue, and are served between two steps.
"""

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
from ctr_nlp.view.live.page.panel import ControlPanel, RecordedMotion
from ctr_nlp.view.live.page.scene import Scene
from ctr_nlp.view.live.page.server import HOST, PORT, start_server, stop_server
from ctr_nlp.view.live.steered.drive import suitable_models
from ctr_nlp.view.live.steered.recording import Recording
from ctr_nlp.view.live.steered.session import Session, SessionState
from ctr_nlp.view.report import page

PROBLEM_ROBOT_LABEL = "the problem's own"
"""Name of the robot that the problem comes with."""
NOTEBOOK_FRAME_HEIGHT_PX = 640
"""Height of the frame in a notebook."""
WAIT_POLL_S = 0.05
"""Time between two checks whether waiting has ended."""
REPORT_PATH = "/report"
REPORT_LINK = f'<a href="{REPORT_PATH}" target="_blank">Open the report of the recording</a>'
"""Address of the report of the last recording, and a link to it."""
TIMED_STEP_COUNT = 60
"""Number of steps over which the share of time that they take is averaged."""
SNAP_NOTICE_S = 4.0
"""Time for which the page says that the robot snapped."""


class Live:
    """Page on which a problem's robot is steered, served from construction until stop().

    url: address of the page. plan: the last motion that was recorded; None before the first.
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
        """Start to serve the page.

        problem: robot and target. model: name of the kinematic model. settings: weights and tolerances. robots:
        others to choose from, by name. host, port: where to serve; port 0 takes any that is free. save_plan:
        called with a recorded plan, in a thread of its own; returns a sentence that says where the plan is. load:
        constant load on the robot, on the elastic model.

        Raises OptionError where the port is in use, nothing can be compiled, or viser is not installed; and as
        Session.
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
        self._report: str | None = None
        self._snapped = -SNAP_NOTICE_S
        self._course = 0.0
        self._writing = list[threading.Thread]()
        self._ending = threading.Event()
        self._failures = list[Exception]()
        self._session = Session(problem, model, settings, load=load)
        self._server = start_server(host, port, {REPORT_PATH: lambda: self._report})
        self.url = f"http://{host}:{self._server.get_port()}"
        self._build_page(PROBLEM_ROBOT_LABEL)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def show(self, height: int = NOTEBOOK_FRAME_HEIGHT_PX) -> Any:
        """Return the page as an IFrame for a notebook, `height` pixels high; raises OptionError outside of
        IPython.
        """
        try:
            from IPython.display import IFrame
        except ImportError as error:
            raise OptionError(f"show() is for notebooks, and IPython is not installed; open {self.url}") from error
        return IFrame(self.url, width="100%", height=height)

    def wait(self, ended: Callable[[], bool]) -> None:
        """Serve until `ended` returns true, in the main thread; raises the error that has ended steering,
        if any.
        """
        while not ended() and self._thread.is_alive():
            time.sleep(WAIT_POLL_S)
        self.stop()

    def stop(self) -> None:
        """End serving once a plan that is being saved is saved; raises the error that has ended steering,
        if any.
        """
        self._ending.set()
        self._thread.join()
        # Only now: until it has ended, the steering thread may still begin to save a plan.
        for writing in self._writing:
            writing.join()
        stop_server(self._server)
        if self._failures:
            raise self._failures[0]

    # Requests of panel and scene, in any thread: panel.SteeringRequests. Each only puts a call into the queue.

    def ask(self, act: Callable[[Session], None]) -> None:
        """Call `act` with the session between two steps."""
        # The session is looked up when the call is made: it may have been replaced since the request.
        self._inbox.put(lambda: act(self._session))

    def play(self, on: bool) -> None:
        """Follow the path to its end and back, again and again, where `on`; else stop that."""
        self._inbox.put(lambda: self._set_off(on))

    def use_robot(self, name: str) -> None:
        """Continue with the robot called `name`, from the beginning of the path."""
        self._inbox.put(lambda: self._replace(name))

    def record(self) -> None:
        """Begin to record, or end it and save the plan."""
        self._inbox.put(self._record)

    def play_recording(self) -> None:
        """Move the robot as it was recorded last."""
        self._inbox.put(self._play_recording)

    # The loop

    def _run(self) -> None:
        """Step after step, each when it is due, until serving ends."""
        try:
            due = time.perf_counter()
            while not self._ending.is_set():
                begin = time.perf_counter()
                self._answer()
                self._show(self._step())
                self._spent.append(time.perf_counter() - begin)
                # A late step is not made up for: steps in quick succession would exceed the motors' speeds.
                due = max(due + self._session.dt, time.perf_counter())
                self._ending.wait(due - time.perf_counter())
        except Exception as error:
            self._failures.append(error)

    def _answer(self) -> None:
        """Serve the requests that came since the last step; one that fails is reported, and changes nothing."""
        while not self._inbox.empty():
            try:
                self._inbox.get()()
            except CtrError as error:
                self._news = f"{error}."

    def _step(self) -> SessionState:
        """Move the target along the path where it is followed, and the robot by one step; return its state."""
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
        """Show a state of the session on the page."""
        session = self._session
        busy = sum(self._spent) / max(len(self._spent), 1) / self._session.dt
        snapped = time.monotonic() - self._snapped < SNAP_NOTICE_S
        # Browsers get the changes of a step together, so that robot and target are of the same moment.
        with self._server.atomic():
            self._scene.show(seen, session.goal.handles, self._panel.colour_quantity)
            self._scene.look_from_tip(self._panel.looks_from_tip, seen.shape)
            news = status_message(session, float(seen.error[-1]), snapped, self._news)
            recorded = RecordedMotion(self.plan is not None, "" if self._report is None else REPORT_LINK)
            self._panel.show(seen, bool(self._course), news, busy, recorded)
        self._server.flush()

    def _build_page(self, robot: str) -> None:
        """Build scene and panel of the session, whose robot is called `robot`."""
        self._scene = Scene(self._server, self._session.problem, self._pull_handle)
        self._panel = ControlPanel(self._server.gui, self._session, tuple(self._robots), robot, self)

    def _pull_handle(self, handle: int, point: Any) -> None:
        self.ask(lambda session: session.pull(handle, point))

    def _set_off(self, on: bool) -> None:
        """Follow the path forwards, or backwards from its end, where `on`; else stop that."""
        self._course = (1.0 if self._session.goal.progress < 1.0 else -1.0) if on else 0.0

    def _replace(self, name: str) -> None:
        """Replace the session by one with another robot; raises OptionError where no model describes it."""
        check_choice("robot", name, self._robots)
        problem = replace(self._problem, robot=self._robots[name])
        load = self._session.load
        models = suitable_models(problem, load)
        if not models:
            borne = "" if load is None else " under a load"
            raise OptionError(f"no model describes the robot {name!r}{borne}")
        before = self._session
        self._course = 0.0
        model = before.requested_model if before.requested_model in models else models[0]
        self._session = Session(problem, model, self._settings, load=load)
        self._panel.remove()
        self._server.scene.reset()
        self._build_page(name)

    def _play_recording(self) -> None:
        if self.plan is None:
            raise OptionError("nothing was recorded yet; press Record, and steer")
        self._course = 0.0
        self._session.play_back(self.plan)

    def _record(self) -> None:
        if self._session.moment_count is None:
            self._session.record()
            self._news = "Everything that the robot does is recorded."
        else:
            # Every recording is waited for at the end, also one that is still being saved when the next one ends.
            # No daemon, as the steering thread is one: Python must not end before the plan is written.
            self._writing = [writing for writing in self._writing if writing.is_alive()]
            recording = self._session.end_recording()
            writing = threading.Thread(target=self._finish_recording, args=(recording,), daemon=False)
            self._writing.append(writing)
            writing.start()
            self._news = "The plan is being made of what was recorded."

    def _finish_recording(self, recording: Recording) -> None:
        """Make a plan of a recording and save it, in a thread of its own while steps go on."""
        try:
            plan = recording.plan().check()
            self.plan = plan
            told = "It is this object's `plan`" if self._keep is None else self._keep(plan)
            self._news = f"The plan of {len(plan.time)} frames was made. {told}.\n\n{verdict_list(plan)}"
        except CtrError as error:
            self._news = f"{error}."
            return
        try:
            self._report = page([plan], ["recorded live"])
        except CtrError as error:
            self._news += f"\n\nThere is no report of the recording: {error}."
