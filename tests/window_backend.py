"""A matplotlib backend that needs no display, and a picture that writes down what it is shown."""

import os
import time
from pathlib import Path
from typing import ClassVar

from matplotlib.backend_bases import FigureManagerBase, TimerBase
from matplotlib.backends.backend_agg import FigureCanvasAgg

CLOSE = "close"
"""The state at which the window is closed, as if by a person."""


class Timer(TimerBase):
    """Rings as long as windows are shown."""

    running: ClassVar[list["Timer"]] = []

    def _timer_start(self):
        self.running.append(self)


class Manager(FigureManagerBase):
    """Shows windows until they are closed."""

    open = True

    @classmethod
    def pyplot_show(cls, *, block=None):
        while cls.open:
            for timer in Timer.running:
                timer._on_timer()
            time.sleep(0.02)


class FigureCanvas(FigureCanvasAgg):
    """Draws as Agg does."""

    manager_class = Manager

    def new_timer(self, interval=None, callbacks=None):
        return Timer(interval, callbacks)


class Written:
    """A picture whose states become lines of a file, the first being the window's process."""

    size = (2.0, 2.0)

    def __init__(self, path: Path) -> None:
        self.path = path

    def begin(self, figure) -> None:
        self.path.write_text(f"{os.getpid()}\n")

    def show(self, state) -> None:
        if state == CLOSE:
            Manager.open = False
        with open(self.path, "a") as file:
            file.write(f"{state}\n")
