"""What a plan holds: arrays over its frames, and meta, which tells how they were made."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np

from ctr_nlp.models import MODELS
from ctr_nlp.robot import Robot
from ctr_nlp.support.equal import Value
from ctr_nlp.support.read_only import read_only
from ctr_nlp.support.values import frozen
from ctr_nlp.typing import Array, Flags


@dataclass(frozen=True, eq=False, repr=False)
class Record(Value):
    """What a plan holds: T frames of motion for a robot of d tubes; the arrays of plan.npz under their names.

    time (T,) s; alpha (T, d) rad; beta (T, d) mm; theta (T, 2) rad; target, shape (T, 101, 3) mm at uniform
    sigma; target_direction, tip_direction (T, 3) unit tangents at the tip; solve_time (T,) s; success (T,);
    objective (T,) mm^2; kkt (T,); stability, stability_between (T,), NaN on the dominant model; to_robot
    (4, 4), file to robot frame; where known, truth (T, 2d + 2), lumen_radius (T, 101) mm at the target's points,
    lumen (N, 4), the path and radius of the whole lumen, mm, clearance (T, 101) mm, what is left between tubes
    and its wall, and free (T, 2d + 2), the motion that was found without the wall. Frames that were never reached
    hold NaN. Arrays and meta are read-only copies.
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
    def can_snap(self) -> bool:
        """Whether a robot can snap on that model."""
        return MODELS[self.evaluated].can_snap

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
