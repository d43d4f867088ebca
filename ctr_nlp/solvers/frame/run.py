"""Frames of one Nlp solved one after the other, each from the one before it, in one call of run.c.

Frame by frame the program of eq. (9) is small. run.c therefore does for all frames what a caller would, without
returning to Python: it sets the bounds |q - q_before| <= most, the parameter `previous` and the start, and solves.
"""

from __future__ import annotations

import ctypes

import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.codegen.c_structures import check_structure
from ctr_nlp.ocp.local_parameters import LocalParameterSource
from ctr_nlp.solvers.frame.adapter import FEASIBILITY_TOLERANCE
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.typing import Array


class _RunStruct(ctypes.Structure):
    """The struct Run of run.c, field by field."""

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


_RUN_SIGNATURE = ctypes.CFUNCTYPE(ctypes.c_long, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_long, ctypes.c_void_p)
"""Signature of the function run of run.c: (struct Run, struct Program, frames, starts or null) -> frames
solved.
"""


class FrameSequence:
    """Arrays for the frames of a program, filled before a call and read after it; not from two threads at once.

    p (frames, n_p): packed parameters, but for those named previous, which are the configuration of the frame
    before. low, high, most (k,): limits of the program's configuration, and by how much each entry may change from
    frame to frame. here (k,): the configuration before the first frame, then of the last that was solved. Results,
    a row a frame: x (frames, n), rows (frames, n + m), multipliers, objective mm^2, kkt, iterations, status,
    seconds, and whether the frame was solved.
    """

    def __init__(self, program: Program, frames: int, optimal: float, extrapolate: bool = False) -> None:
        """Allocate for so many frames of a program.

        optimal: the KKT residual up to which a frame counts as solved; all of them must be feasible. extrapolate:
        whether a frame is started from an extrapolation of x in the frames before, if its merit is better there.
        """
        nlp, (n, rows) = program.nlp, (len(program.x), len(program.rows))
        # C reads the picks as long integers, whatever numpy's default is.
        self._picks = np.ascontiguousarray(nlp.configuration, dtype=np.int64)
        self.program = program
        self.p = np.zeros((frames, len(program.p)))
        self.low, self.high, self.most, self.here = np.zeros((4, len(self._picks)))
        self.x, self.rows, self.multipliers = (np.zeros((frames, width)) for width in (n, rows, rows))
        self.objective, self.kkt, self.seconds = np.zeros((3, frames))
        # course: x's last step, its change from the step before, and the expected next step (run.c).
        self.starts = np.zeros((frames, n))
        self._course = np.zeros((3, n))
        self.iterations, self.status, self.solved = np.zeros((3, frames), dtype=np.int64)
        # Only programs with a motion term have the configuration of the frame before as a parameter.
        previous = nlp.parameter_slice("previous") if "previous" in nlp.parameters else slice(0, 0)
        limits = self._picks, self.p, self.low, self.high, self.most
        found = self.x, self.rows, self.multipliers, self.objective, self.kkt, self.seconds
        self._fixed = (
            len(program.p),
            len(self.here),
            previous.stop - previous.start,
            previous.start,
            *(array.ctypes.data for array in limits),
            FEASIBILITY_TOLERANCE,
            optimal,
            self.here.ctypes.data,
            self._course.ctypes.data if extrapolate else None,
            *(array.ctypes.data for array in (*found, self.iterations, self.status, self.solved)),
        )
        self.set_local_parameters(None)
        library = cache.load_c_files(__package__, "sqp.c", "run.c")
        check_structure(library, "Run", _RunStruct)
        self._run = _RUN_SIGNATURE(("run", library))

    def set_local_parameters(self, local_parameters: LocalParameterSource | None) -> None:
        """Choose how frames are solved from now on: once, or again around their solutions with local parameters.

        local_parameters: their source; None: every frame is solved once.
        """
        nlp = self.program.nlp
        # With null pointers and zeros run.c solves every frame once.
        of_near: tuple[float | None, ...] = (None, None, *[0] * 6, *[0.0] * 4, None)
        if local_parameters is not None:
            place, weight, allowed = (
                nlp.parameter_slice(name)
                for name in (
                    local_parameters.wall_parameter,
                    local_parameters.weight_parameter,
                    local_parameters.allowed_parameter,
                )
            )
            size = place.stop - place.start
            # The described parameter, and after it the slack needed.
            self._found = np.zeros(size + 1)
            # A program without a load has no such parameter; the position is then not read.
            load = (
                nlp.parameter_slice(local_parameters.load_parameter).start
                if local_parameters.load_parameter in nlp.parameters
                else 0
            )
            sizes = load, place.start, size, weight.start, allowed.start, local_parameters.max_rounds
            costs = (
                local_parameters.slack_square_cost,
                local_parameters.excess_factor,
                local_parameters.excess_rounding_mm,
                local_parameters.slack_tolerance_mm,
            )
            of_near = local_parameters.call, local_parameters.context, *sizes, *costs, self._found.ctypes.data
        self._given = _RunStruct(*of_near, *self._fixed)
        self._reference = ctypes.byref(self._given)

    def set_start(self, here: Array, x: Array) -> None:
        """Start the next call at configuration here (k,) and unknowns x, with slacks of 0 after them, and at
        rest.
        """
        self.here[:], self._course[:], self.program.x[:] = here, 0.0, 0.0
        self.program.x[: len(x)] = x

    def __call__(self, frames: int, from_starts: bool = False) -> int:
        """Solve the first `frames` frames from the program's x and multipliers; return how many were solved.

        A frame that is not solved is the last one, and its results are stored too. from_starts: solve each frame
        from its own row of `starts` instead, whether or not others are solved.
        """
        self.program.refresh()
        starts = self.starts.ctypes.data if from_starts else None
        return int(self._run(self._reference, self.program.address, frames, starts))
