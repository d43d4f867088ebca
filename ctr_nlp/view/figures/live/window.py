"""The process of a window: a picture comes through standard input, then states; started by LiveWindow."""

from __future__ import annotations

import os
import pickle
import signal
import sys
import threading
import time
from collections import deque
from typing import Any, BinaryIO

import matplotlib
from matplotlib.backend_bases import TimerBase
from matplotlib.figure import Figure

from ctr_nlp.view.figures.live.view import Picture
from ctr_nlp.view.figures.parts.page import STYLE

PACE_MS = 100
"""Period at which the window looks for a new state."""
NICE = 10
"""Niceness that is added to this process, so that it does not slow the solver."""
UNWATCHED_PAGE_TIMEOUT_S = 60.0
"""Time after the end of the work for which a page (WebAgg) without readers is served."""


class Inbox:
    """Newest of the states that come, received in a thread. ended: monotonic time, s, when no more can come; None
    before.
    """

    def __init__(self, source: BinaryIO) -> None:
        self._source = source
        self._states = deque[Any](maxlen=1)
        self.ended: float | None = None
        threading.Thread(target=self._receive, daemon=True).start()

    def _receive(self) -> None:
        try:
            while True:
                self._states.append(pickle.load(self._source))
        except (EOFError, OSError, pickle.UnpicklingError):
            _detach_standard_streams()
            self.ended = time.monotonic()

    def newest(self) -> list[Any]:
        """Return the newest state that has not been taken, or nothing."""
        return [self._states.pop()] if self._states else []


def open_window(picture: Picture) -> tuple[Figure, TimerBase]:
    """Open a window on `picture`, and return its figure and a timer; raises what the toolkit does where it
    cannot.
    """
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=picture.size)
    timer = figure.canvas.new_timer(interval=PACE_MS)
    # Backends without an event loop, such as Agg, have the base class's timer, which never fires.
    if type(timer) is TimerBase:
        backend = matplotlib.get_backend()
        raise RuntimeError(f"there is no display or no toolkit for it (matplotlib's backend is {backend})")
    picture.begin(figure)
    return figure, timer


def run(source: BinaryIO, picture: Picture, figure: Figure, timer: TimerBase) -> None:
    """Show the states that come until the window is closed.

    source: stream of pickled states. picture: draws them. figure, timer: of the window, from open_window.
    """
    from matplotlib import pyplot

    inbox = Inbox(source)

    def look() -> None:
        for state in inbox.newest():
            picture.show(state)
            figure.canvas.draw_idle()
        # The server of WebAgg does not end by itself, and without a reader nobody can close its page.
        readers = getattr(figure.canvas.manager, "web_sockets", True)
        if inbox.ended is not None and not readers and time.monotonic() > inbox.ended + UNWATCHED_PAGE_TIMEOUT_S:
            os._exit(0)

    timer.add_callback(look)
    timer.start()
    pyplot.show(block=True)


def _detach_standard_streams() -> None:
    """Point output to nowhere: whoever waits for the program's output need not wait for the window."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nothing, stream)
    os.close(nothing)


def main() -> None:
    """Open the window, report on standard output whether that went well, and keep it."""
    # Where processes have no sessions, as on Windows, Ctrl-C in the terminal reaches this one as well.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(NICE)
    source = sys.stdin.buffer
    with matplotlib.rc_context(STYLE):
        try:
            picture: Picture = pickle.load(source)
            figure, timer = open_window(picture)
        except Exception as error:
            sys.stdout.write(f"not:{error}")
            return
        sys.stdout.write("open:")
        sys.stdout.flush()
        # Ends the program's wait for the answer: the pipe on standard output closes, and toolkits print to stderr.
        os.dup2(2, 1)
        run(source, picture, figure, timer)


if __name__ == "__main__":
    main()
