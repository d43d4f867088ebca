"""The process of a window: a picture comes through standard input, then states; run by View."""

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
"""Between two looks at what there is to show."""
NICE = 10
"""By how much this process stands back behind others."""
UNWATCHED_PAGE_TIMEOUT_S = 60.0
"""s after the end of the work for which a page without readers is served."""


class Inbox:
    """The newest of the states that come, received in a thread; ended, s of the clock, once no more can come."""

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
        """The newest state that has not been taken, or nothing."""
        return [self._states.pop()] if self._states else []


def open_window(picture: Picture) -> tuple[Figure, TimerBase]:
    """A window with a picture, and a timer; raises whatever the toolkit does where there can be none."""
    from matplotlib import pyplot

    figure = pyplot.figure(figsize=picture.size)
    timer = figure.canvas.new_timer(interval=PACE_MS)
    if type(timer) is TimerBase:
        backend = matplotlib.get_backend()
        raise RuntimeError(f"there is no display or no toolkit for it (matplotlib's backend is {backend})")
    picture.begin(figure)
    return figure, timer


def run(source: BinaryIO, picture: Picture, figure: Figure, timer: TimerBase) -> None:
    """Show the states that come until the window is closed."""
    from matplotlib import pyplot

    inbox = Inbox(source)

    def look() -> None:
        for state in inbox.newest():
            picture.show(state)
            figure.canvas.draw_idle()
        readers = getattr(figure.canvas.manager, "web_sockets", True)
        if inbox.ended is not None and not readers and time.monotonic() > inbox.ended + UNWATCHED_PAGE_TIMEOUT_S:
            os._exit(0)

    timer.add_callback(look)
    timer.start()
    pyplot.show(block=True)


def _detach_standard_streams() -> None:
    """Whoever waits for the program's output need not wait for the window."""
    nothing = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nothing, stream)
    os.close(nothing)


def main() -> None:
    """Open the window, tell whether that went well, and keep it."""
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
        os.dup2(2, 1)
        run(source, picture, figure, timer)


if __name__ == "__main__":
    main()
