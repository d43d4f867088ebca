"""The panel beside the scene: controls, and the numbers of the moment."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from ctr_nlp.paths.target import Target
from ctr_nlp.typing import Array
from ctr_nlp.view.live.page.colours import (
    COLOUR_BY_CLEARANCE,
    COLOUR_BY_ERROR,
    COLOUR_BY_TUBE,
    RatedNumber,
    legend,
    rate_numbers,
    table,
)
from ctr_nlp.view.live.steered.drive import suitable_models
from ctr_nlp.view.live.steered.joints import slider_ranges
from ctr_nlp.view.live.steered.session import (
    HAND_METHOD,
    MAX_SAMPLED_ROBOTS,
    STEERING_METHODS,
    Session,
    SessionState,
)

PANEL_UPDATE_PERIOD_S = 0.15
"""Time between two changes of numbers and sliders: faster ones cannot be read."""
SLIDER_STEP = 1e-3
"""Step of the sliders of joints, rad and mm."""
PATH_STEP, PATH_DECIMALS = 0.1, 1
"""Step of the slider along the path, mm or s, and decimals of its value, for which its field has room."""


class SteeringRequests(Protocol):
    """Requests from the panel to the program that steers. Each may be made in any thread, and returns at once."""

    def ask(self, act: Callable[[Session], None]) -> None:
        """Call `act` with the session between two steps."""

    def use_robot(self, name: str) -> None:
        """Continue with the robot called `name`."""

    def play(self, on: bool) -> None:
        """Follow the path automatically where `on`; else stop that."""

    def record(self) -> None:
        """Begin to record, or end it and save the plan."""

    def play_recording(self) -> None:
        """Move the robot as it was recorded last."""


class RecordedMotion(NamedTuple):
    """The last recording: whether it can be played, and a link to its report in HTML."""

    can_be_played: bool
    report_link: str


@dataclass(frozen=True)
class PathScale:
    """Scale of the slider along the path: its name, and the values (n,) at equal steps of progress from 0 to 1."""

    name: str
    values: tuple[float, ...]

    @classmethod
    def of_target(cls, target: Target, duration: float) -> PathScale:
        """Return the scale of a target: mm of the path where frames are ever longer, else s of `duration`."""
        lengths = target.lengths
        if len(lengths) > 1 and (np.diff(lengths) > 0).all():
            return cls("along the path, mm", tuple(lengths))
        return cls("time along the motion, s", (0.0, float(duration)))

    def to_value(self, progress: float) -> float:
        """Return the value of the slider at a progress from 0 to 1."""
        return float(np.interp(progress, np.linspace(0.0, 1.0, len(self.values)), self.values))

    def to_progress(self, value: float) -> float:
        """Return the progress, from 0 to 1, at a value of the slider."""
        return float(np.interp(value, self.values, np.linspace(0.0, 1.0, len(self.values))))


class ControlPanel:
    """Controls of one session; removed when another session takes its place."""

    def __init__(
        self, gui: Any, session: Session, robots: Sequence[str], robot: str, requests: SteeringRequests
    ) -> None:
        """Build the controls.

        gui: of the viser server. session: what is steered. robots: names to choose from. robot: the one that is
        chosen. requests: takes the requests.
        """
        self._session = session
        self._asked = requests
        self._last = 0.0
        self._numbers = gui.add_html("")
        self._news = gui.add_markdown("")
        self._all = [self._numbers, self._news]
        with self._register_folder(gui.add_folder("What steers")):
            self._method = self._add_dropdown(gui, "method", STEERING_METHODS, session.method, Session.follow)
            self._add_dropdown(
                gui,
                "model",
                suitable_models(session.problem, session.load),
                session.requested_model,
                Session.use_model,
            )
            self._robots(gui, robots, robot)
        with self._register_folder(gui.add_folder("Target")):
            self._target(gui)
        with self._register_folder(gui.add_folder("Joints (sliders steer by hand)", expand_by_default=False)):
            offered = np.round(slider_ranges(session.problem.robot), 2)
            self._joints = [self._joint(gui, j, span) for j, span in enumerate(offered)]
        with self._register_folder(gui.add_folder("What is seen")):
            self._colouring(gui)
            self._tip_view = gui.add_checkbox("look from the tip", initial_value=False)
        with self._register_folder(gui.add_folder("Recording")):
            self._record = gui.add_button("Record")
            self._record.on_click(lambda _: requests.record())
            self._playback = gui.add_button("Play the recording", disabled=True)
            self._playback.on_click(lambda _: requests.play_recording())
            self._report = gui.add_html("")

    @property
    def colour_quantity(self) -> str:
        """Quantity by which the robot is to be coloured."""
        return str(self._by.value)

    @property
    def looks_from_tip(self) -> bool:
        """Whether the scene is to be seen from the tip."""
        return bool(self._tip_view.value)

    def remove(self) -> None:
        """Remove all controls from the page."""
        for each in self._all:
            each.remove()

    def show(self, seen: SessionState, playing: bool, news: str, busy: float, recorded: RecordedMotion) -> None:
        """Show the numbers of a state, at most every PANEL_UPDATE_PERIOD_S.

        seen: state of the session. playing: whether the path is followed. news: sentences. busy: share of the time
        that steps take. recorded: the last recording.
        """
        if time.monotonic() - self._last < PANEL_UPDATE_PERIOD_S:
            return
        self._last = time.monotonic()
        session = self._session
        rows = rate_numbers(seen, session.problem, session.settings)
        work = RatedNumber("time for a step", f"{1e3 * seen.seconds:.1f} ms", f"busy {busy:.0%}", "")
        self._numbers.content = table([*rows, work])
        self._news.content = news
        self._method.value = session.method
        self._progress.value = round(self._scale.to_value(session.goal.progress), PATH_DECIMALS)
        self._play.label = "Stop following" if playing else "Follow the path"
        self._draws.value = session.sample_count
        self._playback.disabled = not recorded.can_be_played
        self._report.content = recorded.report_link
        count = session.moment_count
        told = "Record" if count is None else f"Stop, and keep {count * session.dt:.1f} s as a plan"
        self._record.label = told
        # By hand the sliders are where a person has put them: they may be ahead of the motors.
        if session.method != HAND_METHOD:
            for slider, value in zip(self._joints, seen.q.tolist(), strict=True):
                slider.value = min(max(round(value, 3), slider.min), slider.max)

    def _register_folder(self, folder: Any) -> Any:
        self._all.append(folder)
        return folder

    def _add_dropdown(
        self, gui: Any, name: str, names: Sequence[str], now: str, do: Callable[[Session, str], None]
    ) -> Any:
        """Add a list of `names` to choose from, whose choice calls `do` with the session and the name."""
        found = gui.add_dropdown(name, tuple(names), initial_value=now)

        @found.on_update
        def _(event: Any) -> None:
            # None means that `show` has set the value, which is no request. So below.
            if event.client_id is not None:
                value = str(found.value)
                self._asked.ask(lambda session: do(session, value))

        return found

    def _robots(self, gui: Any, robots: Sequence[str], robot: str) -> None:
        found = gui.add_dropdown("robot", tuple(robots), initial_value=robot)
        found.on_update(lambda _: self._asked.use_robot(str(found.value)))

    def _target(self, gui: Any) -> None:
        session = self._session
        ask = self._asked.ask
        scale = self._scale = PathScale.of_target(session.problem.target, session.problem.duration)
        low, high = round(scale.values[0], PATH_DECIMALS), round(scale.values[-1], PATH_DECIMALS)
        now = float(np.clip(round(scale.to_value(session.goal.progress), PATH_DECIMALS), low, high))
        self._progress = gui.add_slider(scale.name, low, high + PATH_STEP * (low == high), PATH_STEP, now)
        self._play = gui.add_button("Follow the path")
        release = gui.add_button("Let go of all handles")
        undo = gui.add_button("Undo the last move")
        self._play.on_click(lambda _: self._asked.play(self._play.label == "Follow the path"))
        release.on_click(lambda _: ask(lambda session: session.release()))
        undo.on_click(lambda _: ask(lambda session: session.undo()))

        @self._progress.on_update
        def _(event: Any) -> None:
            if event.client_id is not None:
                value = float(self._progress.value)
                self._asked.play(False)
                ask(lambda session: session.advance(scale.to_progress(value)))

    def _joint(self, gui: Any, joint: int, span: Array) -> Any:
        """Add the slider of a joint, from 0, with a range (2,), rad or mm."""
        name, (low, high) = self._session.problem.robot.axes[joint], span.tolist()
        now = float(np.clip(self._session.q[joint], low, high))
        unit = "mm" if name.startswith("beta") else "rad"
        locked = low == high  # such a joint has a slider that shows it and does not move
        found = gui.add_slider(
            f"{name}, {unit}", low, high + SLIDER_STEP * locked, SLIDER_STEP, now, disabled=locked
        )

        @found.on_update
        def _(event: Any) -> None:
            if event.client_id is not None:
                value = float(found.value)
                self._asked.ask(lambda session: session.slide(joint, value))

        return found

    def _colouring(self, gui: Any) -> None:
        session = self._session
        known = (
            (COLOUR_BY_ERROR, COLOUR_BY_TUBE)
            if session.problem.wall is None
            else (COLOUR_BY_ERROR, COLOUR_BY_CLEARANCE, COLOUR_BY_TUBE)
        )
        self._by = gui.add_dropdown("robot coloured by", known, initial_value=COLOUR_BY_ERROR)
        scale = gui.add_html(legend(session.problem.robot, COLOUR_BY_ERROR))
        self._draws = gui.add_slider("sampled robots", 0, MAX_SAMPLED_ROBOTS, 1, session.sample_count)

        @self._by.on_update
        def _(_: Any) -> None:
            scale.content = legend(session.problem.robot, str(self._by.value))

        @self._draws.on_update
        def _(event: Any) -> None:
            if event.client_id is not None:
                count = int(self._draws.value)
                self._asked.ask(lambda session: session.set_sample_count(count))
