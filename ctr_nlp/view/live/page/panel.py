"""The panel beside the scene: controls, and the numbers of the moment."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any, Protocol

import numpy as np

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
"""Step of the sliders, rad and mm."""


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
        with self._register_folder(gui.add_folder("Recording")):
            self._record = gui.add_button("Record")
            self._record.on_click(lambda _: requests.record())

    @property
    def colour_quantity(self) -> str:
        """Quantity by which the robot is to be coloured."""
        return str(self._by.value)

    def remove(self) -> None:
        """Remove all controls from the page."""
        for each in self._all:
            each.remove()

    def show(self, seen: SessionState, playing: bool, news: str, busy: float) -> None:
        """Show the numbers of a state, at most every PANEL_UPDATE_PERIOD_S.

        seen: state of the session. playing: whether the path is followed. news: sentences. busy: share of the time
        that steps take.
        """
        if time.monotonic() - self._last < PANEL_UPDATE_PERIOD_S:
            return
        self._last = time.monotonic()
        session = self._session
        rows = rate_numbers(seen, session.settings.stability_margin)
        work = RatedNumber("time for a step", f"{1e3 * seen.seconds:.1f} ms", f"busy {busy:.0%}", "")
        self._numbers.content = table([*rows, work])
        self._news.content = news
        self._method.value = session.method
        self._progress.value = round(session.goal.progress, 3)
        self._play.label = "Stop following" if playing else "Follow the path"
        self._draws.value = session.sample_count
        recorded = session.moment_count
        told = "Record" if recorded is None else f"Stop, and keep {recorded * session.dt:.1f} s as a plan"
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
        self._progress = gui.add_slider("progress", 0.0, 1.0, SLIDER_STEP, session.goal.progress)
        self._play = gui.add_button("Follow the path")
        release = gui.add_button("Let go of all handles")
        self._play.on_click(lambda _: self._asked.play(self._play.label == "Follow the path"))
        release.on_click(lambda _: ask(lambda session: session.goal.release()))

        @self._progress.on_update
        def _(event: Any) -> None:
            if event.client_id is not None:
                value = float(self._progress.value)
                self._asked.play(False)
                ask(lambda session: session.goal.advance(value))

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
