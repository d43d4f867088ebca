"""A problem: a robot, the target that it is to follow, and the duration of the motion."""

from __future__ import annotations

import io
import json
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.exceptions import CtrError, OutputError, ProblemError
from ctr_nlp.paths.curve import Curve
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.points import LONGEST_S
from ctr_nlp.paths.target import Frame, Target
from ctr_nlp.paths.wall_surfaces import DrawnWall, walls_to_draw
from ctr_nlp.paths.walls import Body, WallGeometry, is_lumen_wall, nearest_of
from ctr_nlp.robot import Robot
from ctr_nlp.support.atomic_write import write_atomically
from ctr_nlp.support.notebook_card import CardLine, notebook_card_html
from ctr_nlp.support.packing import Packed, packable, unpack_value
from ctr_nlp.support.value_checks import check_instance, checked_path, floats, number
from ctr_nlp.support.value_objects import Value
from ctr_nlp.typing import Array

MAX_TARGET_LENGTH_RATIO = 1.005
"""A target up to this many times longer than the robot reaches is accepted; beta_d then stays at its bound."""
FORMAT = 1
"""Version of the format of problem files."""
OF_TARGET: Any = "of target"
"""Default of a problem's lumen: that of the target, where it has one."""
NOTEBOOK_PICTURE_FRAMES = 5
"""Frames in a notebook's picture."""


@packable("problem")
@dataclass(frozen=True, eq=False, repr=False)
class Problem(Value):
    """A robot that is to follow a target of T frames within a duration.

    ``problem[first:stop]`` are some of its frames, counted from 0, at the same pace.

    Attributes
    ----------
    name : str
        Name, under which plans are reported and saved.
    robot : Robot
        The robot.
    target : Target
        The shapes to follow, T frames, in the robot's frame.
    duration : float
        Time of the motion, s.
    to_robot : array_like or None
        Rigid transform (4, 4) from the axes of the target's file to the robot's frame; None where the target was
        given in the robot's frame.
    truth : array_like or None
        Configurations (T, 2d + 2) that the target was made with, rad and mm, where they are known.
    lumen : Curve or None
        Path with the radius of the lumen, in the robot's frame; longer than the target where more of it is known.
        None: no wall. By default the target's own curve, where all frames share one that has a radius.
    space : str or None
        Patient coordinates of the target's file, LPS, RAS or LAS, or xyz where it does not say.
    walls : tuple of Body
        Surfaces that the robot stays inside of, or keeps away from, in the robot's frame. Where it stays inside of
        one of them, the lumen's radius is no wall: it describes the path alone.
    space_assumed : bool
        Whether these coordinates were assumed: neither did the file state them, nor did a person.
    notes : tuple of str
        What was assumed, repaired or left out when the target's file was read, a sentence each.

    Raises
    ------
    ProblemError
        A field is not what it must be, or the target is longer than the robot reaches.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> path = ctr.curve_from_points([[0, 0, 0], [0, 2, 30], [0, 8, 60], [0, 18, 90]], radius=[4, 4, 4, 4])
    >>> problem = ctr.Problem("bend", ctr.table_i_robot(), ctr.growing(path, frames=20))
    >>> problem
    Problem(bend: 20 frames in 10 s, up to 92.3 mm, 3 tubes, within a lumen)
    >>> problem[:10].duration
    5.0
    """

    name: str
    robot: Robot
    target: Target
    duration: float = 10.0
    to_robot: Array | None = None
    truth: Array | None = None
    lumen: Curve | None = OF_TARGET
    space: str | None = None
    walls: tuple[Body, ...] = ()
    space_assumed: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, kind in (("name", str), ("robot", Robot), ("target", Target)):
            check_instance(ProblemError, f"{name} of a problem", getattr(self, name), kind)
        if self.space is not None:
            check_instance(ProblemError, "space of a problem", self.space, str)
        allowed = f"be a finite number > 0, at most {LONGEST_S:g}"
        number(ProblemError, "duration", self.duration, lambda x: 0 < x <= LONGEST_S, allowed, " s")
        for name, shape in (("to_robot", (4, 4)), ("truth", (self.frames, 2 * self.robot.d + 2))):
            if getattr(self, name) is not None:  # a read-only copy is kept
                object.__setattr__(self, name, floats(ProblemError, name, getattr(self, name), shape))
        longest = max(self.target.lengths)
        reach = self.robot.reach
        if longest > reach * MAX_TARGET_LENGTH_RATIO:
            usual = self.robot.tubes[-1].usual_extension
            limited = f"; the limits of the robot let beta_{self.robot.d} go to {reach:g} of {usual:g} mm"
            # Only paths that are read from files can be trimmed; they have the name of their coordinates.
            remedy = "choose a longer robot or a shorter path"
            if self.space is not None:
                remedy = (
                    f"--trim start moves the robot's base {longest - reach:.1f} mm inwards, --trim end stops "
                    f"{longest - reach:.1f} mm before the target"
                )
            raise ProblemError(
                f"the target of {self.name} is {longest:.2f} mm long and the robot reaches {reach:.2f} mm "
                f"(0.5 % more is accepted); {remedy}{limited if reach < usual else ''}"
            )
        first = self.target.curves[0]
        if self.lumen is OF_TARGET:
            alone = all(curve is first for curve in self.target.curves)
            object.__setattr__(self, "lumen", first if alone and first.radius is not None else None)
        # None is a choice of its own, no wall, so that the default needs another mark (OF_TARGET).
        elif self.lumen is not None and (not isinstance(self.lumen, Curve) or self.lumen.radius is None):
            raise ProblemError("lumen is a curve without a radius; give one, or None where no wall is known")
        object.__setattr__(self, "walls", tuple(self.walls))
        for body in self.walls:
            check_instance(ProblemError, "a wall of a problem", body, Body)
        nearest_of(None, self.walls)  # each must have a name of its own

    @property
    def frames(self) -> int:
        """Number of frames T."""
        return len(self.target)

    @property
    def dt(self) -> float:
        """Time from frame to frame, s."""
        # T steps: the motion starts at time 0, and frame 1 of T is at dt.
        return self.duration / self.frames

    @property
    def deviation(self) -> float:
        """By how much smoothing moved the target at most, mm; 0 without smoothing."""
        # Frames of one path share one curve; of a sequence the worst counts.
        return max(curve.deviation for curve in self.target.curves)

    @property
    def deviation_share(self) -> float:
        """Largest part of the lumen's radius by which smoothing moved the target; 0 where no radius is known."""
        return max(curve.deviation_share for curve in self.target.curves)

    def retraction(self) -> Problem:
        """Return the problem with its frames in the opposite order, named ``NAME-retraction``.

        Returns
        -------
        Problem
            The robot follows the path back out of the lumen.
        """
        target = Target(self.target.curves[::-1], self.target.lengths[::-1])
        truth = None if self.truth is None else self.truth[::-1]
        return replace(self, name=f"{self.name}-retraction", target=target, truth=truth)

    @cached_property
    def target_frames(self) -> tuple[Frame, ...]:
        """The target at 101 uniform sigma, frame by frame."""
        return self.target.sample()

    @cached_property
    def sampled_lumen(self) -> Lumen | None:
        """The lumen sampled every half mm, as clearances are computed with it; None where none is known."""
        return None if self.lumen is None else Lumen.from_curve(self.lumen)

    @property
    def lumen_wall(self) -> Lumen | None:
        """The lumen where the tube around the path is a wall; None where a body is what the robot is in."""
        return self.sampled_lumen if is_lumen_wall(self.walls) else None

    @property
    def drawn_walls(self) -> list[DrawnWall]:
        """Surfaces of the walls other than the lumen around the target, for pictures."""
        return walls_to_draw(self.walls, np.concatenate([frame.points for frame in self.target_frames]))

    @cached_property
    def wall(self) -> WallGeometry | None:
        """The wall that counts at every point: that of the lumen, or the nearest of several; None for none."""
        return nearest_of(self.sampled_lumen, self.walls)

    def __getitem__(self, frames: slice) -> Problem:
        """Return some of the frames, as ``problem[first:stop]``, at the same pace."""
        if not isinstance(frames, slice) or frames.step not in (None, 1) or not range(self.frames)[frames]:
            raise ProblemError(f"frames of a problem are {frames!r}; give [first:stop] within 0 and {self.frames}")
        target = self.target[frames]
        truth = None if self.truth is None else self.truth[frames]
        return replace(self, target=target, duration=self.dt * len(target), truth=truth)

    def __repr__(self) -> str:
        walled = ", within a lumen" if self.lumen is not None else ""
        walled += "".join(f", {'outside of' if body.keep_out else 'inside'} {body.name}" for body in self.walls)
        return (
            f"Problem({self.name}: {self.frames} frames in {self.duration:g} s, up to "
            f"{max(self.target.lengths):.1f} mm, {self.robot.d} tubes{walled})"
        )

    def _repr_html_(self) -> str:
        frames = [
            self.target_frames[j]
            for j in np.unique(np.linspace(0, self.frames - 1, NOTEBOOK_PICTURE_FRAMES).round().astype(int))
        ]
        rows: list[tuple[str, object]] = [
            ("frames", self.frames),
            ("duration", f"{self.duration:g} s"),
            ("longest target", f"{max(self.target.lengths):.2f} mm"),
            ("largest curvature", f"{max(frame.curvature.max() for frame in self.target_frames):.4f} per mm"),
            ("tubes", self.robot.d),
            ("reach", f"{self.robot.reach:.2f} mm"),
        ]
        radii = [frame.radius.min() for frame in self.target_frames if frame.radius is not None]
        rows += [("least radius of the lumen", f"{min(radii):.2f} mm")] if radii else []
        return notebook_card_html(self.name, [CardLine(frame.points, "#0072b2") for frame in frames], rows)

    def save(self, path: str | Path) -> None:
        """Write the problem to a file, whole or not at all.

        Beside what :meth:`load` needs, the file holds ``target`` (T, 101, 3), mm, at uniform sigma, for other
        programs.

        Parameters
        ----------
        path : str or Path
            The file (.npz); it is read without pickle.

        Raises
        ------
        OutputError
            The file cannot be written, or a curve has functions of the user's own, which no file can hold.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> import ctr_nlp as ctr
        >>> from ctr_nlp.problems import named_problem
        >>> problem = named_problem("arc", frames=3)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     problem.save(Path(folder) / "arc.npz")
        ...     ctr.Problem.load(Path(folder) / "arc.npz") == problem
        True
        """
        path = checked_path(OutputError, path)
        # Curves refer to functions; packing names them by class and method, so that reading the file runs no
        # foreign code.
        packed = Packed()
        try:
            told = {"problem": packed.add(self), "table": packed.table, "format": FORMAT}
            meta = np.array(json.dumps(told, allow_nan=False))
            arrays = {"meta": meta, "target": np.array([frame.points for frame in self.target_frames])}
            with write_atomically(path) as partial, open(partial, "wb") as file:
                np.savez_compressed(file, **packed.arrays, **arrays)  # type: ignore[arg-type]
        except (OSError, TypeError, ValueError) as error:
            raise OutputError(f"problem cannot be written to {path}: {error}") from error

    @classmethod
    def load(cls, path: str | Path) -> Problem:
        """Read a problem from a file without pickle.

        Parameters
        ----------
        path : str or Path
            A file that :meth:`save` has written.

        Returns
        -------
        Problem
            The problem that was saved.

        Raises
        ------
        OutputError
            The file cannot be read, is damaged or holds no problem.
        """
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
                found = unpack_value(told["problem"], told["table"], data)
        except CtrError as error:
            raise OutputError(f"{path} is not a problem: {error}") from error
        except Exception as error:  # whatever the readers of zip archives, arrays and JSON meet in a damaged file
            raise OutputError(f"{path} is not a problem: it is damaged, or another file: {error}") from error
        if not isinstance(found, cls):
            raise OutputError(f"{path} is not a problem: it holds {found!r:.60}")
        return found
