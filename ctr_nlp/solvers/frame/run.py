"""Frames of one Nlp solved one after the other, each from the one before it, in one call of run.c."""

from __future__ import annotations

import ctypes

import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.solvers.frame.adapter import FEASIBLE, Surroundings
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.typing import Array


class _Given(ctypes.Structure):
    """The struct Run of run.c."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in ("around", "of")),
        *((name, ctypes.c_long) for name in ("load", "place", "described", "weight", "allowed", "rounds")),
        *((name, ctypes.c_double) for name in ("firm", "hard", "rounded", "settled")),
        ("found", ctypes.c_void_p),
        *((name, ctypes.c_long) for name in ("sizes_p", "picked", "decided", "previous")),
        *((name, ctypes.c_void_p) for name in ("picks", "p", "low", "high", "most")),
        *((name, ctypes.c_double) for name in ("feasible", "optimal")),
        *(
            (name, ctypes.c_void_p)
            for name in ("here", "course", "x", "rows", "multipliers", "objective", "kkt", "seconds")
        ),
        *((name, ctypes.c_void_p) for name in ("iterations", "status", "solved")),
    ]


_RUN = ctypes.CFUNCTYPE(ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long, ctypes.c_void_p)
"""The function run of run.c."""


class Run:
    """Room for so many frames of a program, filled before a call and read after it; not from two threads at once.

    p (frames, n_p): packed parameters, but for those named previous, which are the configuration of the frame
    before. low, high, most (k,): within which the program's configuration may be, and by how much each entry may
    change from frame to frame. here (k,): the configuration before the first frame, then of the last that was
    solved. x (frames, n), rows (frames, n + m), multipliers, objective mm^2, kkt, iterations, status, seconds, and
    whether it was solved are what was found of each frame.
    """

    def __init__(self, program: Program, frames: int, optimal: float, goes_on: bool = False) -> None:
        """optimal: the KKT residual up to which a frame counts as solved; all of them must be feasible.

        goes_on: whether a frame is begun where the movement of x in the frames before leads, where that is better.
        """
        nlp, (n, rows) = program.nlp, (len(program.x), len(program.rows))
        self._picks = np.ascontiguousarray(nlp.configuration, dtype=np.int64)
        self.program, self.p = program, np.zeros((frames, len(program.p)))
        self.low, self.high, self.most, self.here = np.zeros((4, len(self._picks)))
        self.x, self.rows, self.multipliers = (np.zeros((frames, width)) for width in (n, rows, rows))
        self.objective, self.kkt, self.seconds = np.zeros((3, frames))
        self.starts, self._course = np.zeros((frames, n)), np.zeros((3, n))
        self.iterations, self.status, self.solved = np.zeros((3, frames), dtype=np.int64)
        previous = nlp.place("previous") if "previous" in nlp.parameters else slice(0, 0)
        limits = self._picks, self.p, self.low, self.high, self.most
        found = self.x, self.rows, self.multipliers, self.objective, self.kkt, self.seconds
        self._fixed = (
            len(program.p),
            len(self.here),
            previous.stop - previous.start,
            previous.start,
            *(array.ctypes.data for array in limits),
            FEASIBLE,
            optimal,
            self.here.ctypes.data,
            self._course.ctypes.data if goes_on else None,
            *(array.ctypes.data for array in (*found, self.iterations, self.status, self.solved)),
        )
        self.keep_near(None)
        self._run = _RUN(("run", cache.loaded(__package__, "sqp.c", "run.c")))

    def keep_near(self, near: Surroundings | None) -> None:
        """From now on, solve every frame again around its solution; None: as it is, once."""
        nlp = self.program.nlp
        of_near: tuple[float | None, ...] = (None, None, *[0] * 6, *[0.0] * 4, None)
        if near is not None:
            place, weight, allowed = (nlp.place(name) for name in (near.described, near.weight, near.allowed))
            size = place.stop - place.start
            self._found = np.zeros(size + 1)
            load = nlp.place(near.load).start if near.load in nlp.parameters else 0
            sizes = load, place.start, size, weight.start, allowed.start, near.rounds
            costs = near.firm, near.hard, near.rounded, near.settled
            of_near = near.call, near.of, *sizes, *costs, self._found.ctypes.data
        self._given = _Given(*of_near, *self._fixed)
        self._reference = ctypes.byref(self._given)

    def stand(self, here: Array, x: Array) -> None:
        """Begin the next call at configuration here (k,) and at unknowns x, slacks of 0 after them, at rest."""
        self.here[:], self._course[:], self.program.x[:] = here, 0.0, 0.0
        self.program.x[: len(x)] = x

    def __call__(self, frames: int, from_starts: bool = False) -> int:
        """Solve the first so many frames from the program's x and multipliers; how many were solved.

        Where one is not, it is the last that was tried: what was found of it is there too. from_starts: each from
        its own row of starts instead, whatever comes of the others.
        """
        self.program.refresh()
        starts = self.starts.ctypes.data if from_starts else None
        return int(self._run(self._reference, self.program.address, frames, starts))
