"""A problem: a robot, what it is to follow, and how long that may take."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.exceptions import CtrError, OutputError, ProblemError
from ctr_nlp.robot import Robot
from ctr_nlp.support.cards import Line, card
from ctr_nlp.support.equal import Value
from ctr_nlp.support.packing import Packed, packable, unpacked
from ctr_nlp.support.values import checked_path, floats, instance, number
from ctr_nlp.support.whole_file import whole_file
from ctr_nlp.target.curve import Curve
from ctr_nlp.target.lumen import Lumen
from ctr_nlp.target.points import LONGEST_S
from ctr_nlp.target.target import Frame, Target
from ctr_nlp.typing import Array

OVERLONG = 1.005
"""A target up to this many times longer than the robot reaches is accepted; beta_d then stays at its bound."""
FORMAT = 1
"""Of problem files."""
OF_TARGET: Any = "of target"
"""A lumen that is the target's own, where that has one."""
SHOWN = 5
"""Frames in a notebook's picture."""


@packable("problem")
@dataclass(frozen=True, eq=False, repr=False)
class Problem(Value):
    """A robot that is to follow a target of T frames within a duration in s.

    to_robot: transform (4, 4) from the target's file, in its own coordinates, to the robot's frame; None where the
    target was given in the robot's frame. space: the patient coordinates of that file, LPS, RAS or LAS, or xyz
    where it does not say; None where there is no file. truth: q (T, 2d + 2) where it is known. lumen: the path
    with the lumen's radius along it, in the robot's frame, longer than the target where more of it is known, or
    None: no wall is known. By default (OF_TARGET) the target where all frames share a curve with a radius, else
    None.
    problem[first:stop] are some of its frames, counted from 0, at the same pace. Raises ProblemError.
    """

    name: str
    robot: Robot
    target: Target
    duration: float = 10.0
    to_robot: Array | None = None
    truth: Array | None = None
    lumen: Curve | None = OF_TARGET
    space: str | None = None

    def __post_init__(self) -> None:
        for name, kind in (("name", str), ("robot", Robot), ("target", Target)):
            instance(ProblemError, f"{name} of a problem", getattr(self, name), kind)
        if self.space is not None:
            instance(ProblemError, "space of a problem", self.space, str)
        allowed = f"be a finite number > 0, at most {LONGEST_S:g}"
        number(ProblemError, "duration", self.duration, lambda x: 0 < x <= LONGEST_S, allowed, " s")
        for name, shape in (("to_robot", (4, 4)), ("truth", (self.frames, 2 * self.robot.d + 2))):
            if getattr(self, name) is not None:  # a read-only copy is kept
                object.__setattr__(self, name, floats(ProblemError, name, getattr(self, name), shape))
        longest, reach = max(self.target.lengths), self.robot.reach
        if longest > reach * OVERLONG:
            raise ProblemError(
                f"the target of {self.name} is {longest:.2f} mm long and the robot reaches {reach:.2f} mm "
                f"(0.5 % more is accepted); say which end to drop, --trim start or --trim end"
            )
        first = self.target.curves[0]
        if self.lumen is OF_TARGET:
            alone = all(curve is first for curve in self.target.curves)
            object.__setattr__(self, "lumen", first if alone and first.radius is not None else None)
        elif self.lumen is not None and (not isinstance(self.lumen, Curve) or self.lumen.radius is None):
            raise ProblemError("lumen is a curve without a radius; give one, or None where no wall is known")

    @property
    def frames(self) -> int:
        """T, the number of frames."""
        return len(self.target)

    @property
    def dt(self) -> float:
        """Time from frame to frame, s."""
        return self.duration / self.frames

    @property
    def deviation(self) -> float:
        """How far smoothing, where asked for, moved the target at most, mm."""
        return max(curve.deviation for curve in self.target.curves)

    @property
    def deviation_share(self) -> float:
        """How much of the lumen's radius that is at most; 0 where no radius is known."""
        return max(curve.deviation_share for curve in self.target.curves)

    def retraction(self) -> Problem:
        """The same frames in the opposite order, named so."""
        target = Target(self.target.curves[::-1], self.target.lengths[::-1])
        truth = None if self.truth is None else self.truth[::-1]
        return replace(self, name=f"{self.name}-retraction", target=target, truth=truth)

    @cached_property
    def samples(self) -> tuple[Frame, ...]:
        """The target at 101 uniform sigma, frame by frame."""
        return self.target.sample()

    @cached_property
    def sampled_lumen(self) -> Lumen | None:
        """The path and the radius of the lumen as they are used, every half mm; None where none is known."""
        return None if self.lumen is None else Lumen.around(self.lumen)

    def __getitem__(self, frames: slice) -> Problem:
        if not isinstance(frames, slice) or frames.step not in (None, 1) or not range(self.frames)[frames]:
            raise ProblemError(f"frames of a problem are {frames!r}; give [first:stop] within 0 and {self.frames}")
        target = self.target[frames]
        truth = None if self.truth is None else self.truth[frames]
        return replace(self, target=target, duration=self.dt * len(target), truth=truth)

    def __repr__(self) -> str:
        walled = ", within a lumen" if self.lumen is not None else ""
        return (
            f"Problem({self.name}: {self.frames} frames in {self.duration:g} s, up to "
            f"{max(self.target.lengths):.1f} mm, {self.robot.d} tubes{walled})"
        )

    def _repr_html_(self) -> str:
        frames = [self.samples[j] for j in np.unique(np.linspace(0, self.frames - 1, SHOWN).round().astype(int))]
        rows: list[tuple[str, object]] = [
            ("frames", self.frames),
            ("duration", f"{self.duration:g} s"),
            ("longest target", f"{max(self.target.lengths):.2f} mm"),
            ("largest curvature", f"{max(frame.curvature.max() for frame in self.samples):.4f} per mm"),
            ("tubes", self.robot.d),
            ("reach", f"{self.robot.reach:.2f} mm"),
        ]
        radii = [frame.radius.min() for frame in self.samples if frame.radius is not None]
        rows += [("least radius of the lumen", f"{min(radii):.2f} mm")] if radii else []
        return card(self.name, [Line(frame.points, "#0072b2") for frame in frames], rows)

    def save(self, path: str | Path) -> None:
        """Write the problem to a file (.npz), whole or not at all, that is read without pickle.

        Beside what load needs it holds target (T, 101, 3) mm at uniform sigma, for others. Raises OutputError,
        also where a curve has functions of the user's own, which no file can hold.
        """
        path, packed = checked_path(OutputError, path), Packed()
        try:
            told = {"problem": packed.add(self), "table": packed.table, "format": FORMAT}
            meta = np.array(json.dumps(told, allow_nan=False))
            arrays = {"meta": meta, "target": np.array([frame.points for frame in self.samples])}
            with whole_file(path) as partial, open(partial, "wb") as file:
                np.savez_compressed(file, **packed.arrays, **arrays)  # type: ignore[arg-type]
        except (OSError, TypeError, ValueError) as error:
            raise OutputError(f"problem cannot be written to {path}: {error}") from error

    @classmethod
    def load(cls, path: str | Path) -> Problem:
        """Read what save wrote; raises OutputError where it cannot be read or is no problem."""
        path = checked_path(OutputError, path)
        try:
            content = path.read_bytes()
        except OSError as error:
            raise OutputError(f"problem {path} cannot be read: {error.strerror}") from error
        try:
            with np.load(io.BytesIO(content), allow_pickle=False) as data:
                told = json.loads(str(data["meta"]))
                if told["format"] != FORMAT:
                    raise OutputError(f"it has format {told['format']!r}; this version reads {FORMAT}")
                found = unpacked(told["problem"], told["table"], data)
        except CtrError as error:
            raise OutputError(f"{path} is not a problem: {error}") from error
        except Exception as error:  # whatever the readers of zip archives, arrays and JSON meet in a damaged file
            raise OutputError(f"{path} is not a problem: it is damaged, or another file: {error}") from error
        if not isinstance(found, cls):
            raise OutputError(f"{path} is not a problem: it holds {found!r:.60}")
        return found
