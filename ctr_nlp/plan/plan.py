"""A plan: configurations over time with the shapes and targets they belong to, and plan.npz."""

from __future__ import annotations

import importlib.metadata
import json
import platform
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.exceptions import CtrError, OutputError
from ctr_nlp.models import Snap
from ctr_nlp.plan.metrics import rms_over_sigma, root_mean_square
from ctr_nlp.plan.stored import FORMAT, check_arrays, check_meta, stored
from ctr_nlp.plan.verdicts import Verdicts, verdicts
from ctr_nlp.robot import Robot
from ctr_nlp.simulation.forward import Simulation, simulated
from ctr_nlp.support.read_only import read_only
from ctr_nlp.support.values import checked_path, frozen
from ctr_nlp.support.whole_file import whole_file
from ctr_nlp.target.lumen import Lumen
from ctr_nlp.target.problem import Problem
from ctr_nlp.target.target import SIGMA
from ctr_nlp.typing import Array, Flags

ELSEWHERE = 0.05
"""rad: a robot whose tubes are turned by more from what was planned is in another equilibrium."""


@dataclass(frozen=True)
class Plan:
    """T frames of motion for a robot of d tubes; the arrays of plan.npz under their names.

    time (T,) s; alpha (T, d) rad; beta (T, d) mm; theta (T, 2) rad; target, shape (T, 101, 3) mm at uniform
    sigma; target_direction, tip_direction (T, 3) unit tangents at the tip; solve_time (T,) s; success (T,);
    objective (T,) mm^2; kkt (T,); stability, stability_between (T,), NaN on the dominant model; to_robot
    (4, 4), file to robot frame; where known, truth (T, 2d + 2), lumen_radius (T, 101) mm at the target's points,
    lumen (N, 4), the path and radius of the whole lumen, mm, clearance (T, 101) mm, what is left between tubes
    and its wall, and free (T, 2d + 2), the motion that was found without the wall. Frames that were never reached
    hold NaN. A plan keeps read-only copies of its arrays and of meta.
    """

    time: Array
    alpha: Array
    beta: Array
    theta: Array
    target: Array
    shape: Array
    target_direction: Array
    tip_direction: Array
    solve_time: Array
    success: Flags
    objective: Array
    kkt: Array
    stability: Array
    stability_between: Array
    to_robot: Array
    meta: dict[str, Any]
    lumen_radius: Array | None = None
    truth: Array | None = None
    lumen: Array | None = None
    clearance: Array | None = None
    free: Array | None = None

    def __post_init__(self) -> None:
        for f in fields(self):
            given = getattr(self, f.name)
            kept = read_only(given) if f.name == "meta" else None if given is None else frozen(given)
            object.__setattr__(self, f.name, kept)

    def __reduce__(self) -> Any:
        return Plan, tuple(getattr(self, f.name) for f in fields(self))

    @cached_property
    def robot(self) -> Robot:
        """The robot that the plan is for."""
        return Robot.from_dict(self.meta["robot"])

    @cached_property
    def q(self) -> Array:
        """Configurations (T, 2d + 2), eq. (5)."""
        return frozen(np.concatenate([self.alpha, self.beta, self.theta], axis=1))

    @property
    def dt(self) -> float:
        """Time from frame to frame, s."""
        return float(self.time[0])

    @property
    def evaluated(self) -> str:
        """The model that its shapes and margins are those of."""
        return str(self.meta.get("evaluated", self.meta["model"]))

    @property
    def elastic(self) -> bool:
        """Whether that is the elastic one."""
        return self.evaluated == "elastic"

    @cached_property
    def reached(self) -> Flags:
        """Frames (T,) that have a shape, solved or not."""
        return frozen(np.asarray(np.isfinite(self.shape).all(axis=(1, 2))))

    @property
    def complete(self) -> bool:
        """Whether every frame was solved."""
        return bool(self.success.all())

    @property
    def options(self) -> dict[str, Any]:
        """What the plan was made with, by name; empty where whoever made it does not tell."""
        return dict(self.meta.get("options", {}))

    @cached_property
    def verdicts(self) -> Verdicts:
        """Whether the plan does what was asked of it, one verdict a matter."""
        return verdicts(self)

    def reversed(self) -> Plan:
        """The same motion played backwards, at the same pace."""
        kept = ("time", "to_robot", "lumen", "meta")
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in kept}
        turned: dict[str, Any] = {name: None if array is None else array[::-1] for name, array in arrays.items()}
        return replace(self, meta=self.meta | {"reversed": not self.meta.get("reversed", False)}, **turned)

    def on(self, model: str) -> Plan:
        """The same motion on another model: shapes, tip directions and stability of the robot moved through it."""
        moved = simulated(self.robot, self.q, model)
        return replace(
            self,
            shape=moved.shape,
            tip_direction=moved.tip_direction,
            stability=moved.stability,
            stability_between=moved.stability_between,
            clearance=_clearance(self.robot, self.lumen, self.beta, moved.shape),
            meta=self.meta
            | _told(moved)
            | {"evaluated": model, "e3_free": _e3_free(self.robot, self.free, self.target, moved.shape, model)},
        )

    def save(self, path: str | Path) -> None:
        """Write plan.npz, whole or not at all; raises OutputError."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "meta"}
        present = {name: array for name, array in arrays.items() if array is not None}
        target, told = checked_path(OutputError, path), self._meta_as_json()
        try:
            with whole_file(target) as partial, open(partial, "wb") as file:
                np.savez_compressed(file, meta=np.array(told), **present)
        except OSError as error:
            raise OutputError(f"plan cannot be written to {target}: {error}") from error

    def _meta_as_json(self) -> str:
        try:
            return json.dumps(self.meta, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise OutputError(f"meta of the plan cannot be written as JSON: {error}") from error

    @classmethod
    def load(cls, path: str | Path) -> Plan:
        """Read plan.npz without pickle; raises OutputError where it is not a plan."""
        path = checked_path(OutputError, path)
        try:
            arrays, meta = stored(path)
            check_meta(meta)
            check_arrays(arrays, Robot.from_dict(meta["robot"]).d)
            return cls(meta=meta, **arrays)
        except CtrError as error:
            raise OutputError(f"{path} is not a plan: {error}") from error


def plan_from_configurations(
    problem: Problem,
    q: Array,
    meta: dict[str, Any],
    *,
    success: Flags,
    solve_time: Array,
    objective: Array,
    kkt: Array,
    planned: Array | None = None,
    free: Array | None = None,
) -> Plan:
    """The plan that moves a problem's robot through q (T, 2d + 2); meta tells how q was found.

    planned: the unknowns (T, n) meant, where q does not determine them: frames in which the robot, moved through
    q, is elsewhere are marked as not solved. free: the motion (T, 2d + 2) that was found without the wall.
    """
    robot, frames = problem.robot, problem.samples
    moved = simulated(robot, q, meta["model"])
    if planned is not None:
        lost = success & elsewhere(moved.x, planned, moved.snaps)
        success = success & ~lost
        meta = meta | {
            "failures": meta["failures"] | {str(j + 1): _lost(j, moved) for j in map(int, np.flatnonzero(lost))}
        }
    alpha, beta, theta = robot.split(q)
    radii = [frame.radius for frame in frames]
    lumen = None if problem.lumen is None else Lumen.around(problem.lumen).table
    target = np.array([frame.points for frame in frames])
    return Plan(
        time=np.arange(1.0, problem.frames + 1) * problem.dt,
        alpha=alpha,
        beta=beta,
        theta=theta,
        target=target,
        shape=moved.shape,
        target_direction=np.array([frame.tangents[-1] for frame in frames]),
        tip_direction=moved.tip_direction,
        solve_time=solve_time,
        success=success,
        objective=objective,
        kkt=kkt,
        stability=moved.stability,
        stability_between=moved.stability_between,
        to_robot=np.eye(4) if problem.to_robot is None else problem.to_robot,
        meta=meta
        | _told(moved)
        | {
            "problem": {
                "name": problem.name,
                "frames": problem.frames,
                "duration": problem.duration,
                "deviation": problem.deviation,
                "deviation_share": problem.deviation_share,
            },
            "robot": robot.to_dict(),
            "versions": {
                "ctr_nlp": importlib.metadata.version("ctr_nlp"),
                "casadi": ca.CasadiMeta.version(),
                "numpy": np.__version__,
                "python": platform.python_version(),
            },
            "format": FORMAT,
            "e3_free": _e3_free(robot, free, target, moved.shape, meta["model"]),
        },
        lumen_radius=None if any(radius is None for radius in radii) else np.array(radii),
        truth=problem.truth,
        lumen=lumen,
        clearance=_clearance(robot, lumen, beta, moved.shape),
        free=free,
    )


def _clearance(robot: Robot, lumen: Array | None, beta: Array, shape: Array) -> Array | None:
    """What is left (T, 101) mm where the lumen (N, 4) is known."""
    return None if lumen is None else Lumen(lumen).clearance(robot, beta, SIGMA, shape)


def _e3_free(robot: Robot, free: Array | None, target: Array, shape: Array, model: str) -> float | None:
    """e3 in mm of a motion free of the wall, over the frames of which a shape (T, 101, 3) is known.

    None without such a motion, or where its shape is not known in all of them.
    """
    if free is None:
        return None
    e2 = rms_over_sigma(np.linalg.norm(simulated(robot, free, model).shape - target, axis=-1))
    e2 = e2[np.isfinite(shape).all(axis=(1, 2))]
    return root_mean_square(e2) if np.isfinite(e2).all() else None


def elsewhere(x: Array, planned: Array, snaps: Sequence[Snap]) -> Flags:
    """In which frames (T,) a robot with unknowns x (T, n) is not where it was planned to be, or just snapped."""
    away = ~(np.abs(x - planned).max(axis=1) < ELSEWHERE)
    away[[snap.frame - 1 for snap in snaps]] = True
    return away


def _told(moved: Simulation) -> dict[str, Any]:
    """For a plan's meta: where the robot snaps."""
    return {"snaps": [snap._asdict() for snap in moved.snaps]}


def _lost(frame: int, moved: Simulation) -> str:
    """Why a robot is not where it was planned to be."""
    before = [snap.frame for snap in moved.snaps if snap.frame <= frame + 1]
    why = f"it snaps in frame {before[-1]}" if before else "another equilibrium is reached first"
    return f"the robot would be elsewhere: {why}"
