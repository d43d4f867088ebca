"""The limits of a robot's motors, as a user describes them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from ctr_nlp.support.packing import packable
from ctr_nlp.support.values import unchanging


@packable("limits")
@dataclass(frozen=True)
class Limits:
    """What the hardware allows: position, speed and acceleration of alpha, beta and theta.

    Positions are (lower, upper), or one such pair a tube (theta: one for x, one for y); speeds and
    accelerations are a number, or one a tube. beta = None means [0, curved_length] for every tube.
    Units: rad, mm, s. carriage_gap: least (L_{i+1} - beta_{i+1}) - (L_i - beta_i) in mm, None for no such
    limit. Lists and arrays are kept as tuples. Steering frame by frame keeps positions and speeds; how much of
    the acceleration it uses is in the plan's summary (acceleration_used, more than 1 where it is too much). The
    default speeds are 0.2 rad, 9 mm and 0.08 rad a frame for 100 frames in 10 s.
    """

    alpha: Any = (-math.inf, math.inf)
    beta: Any = None
    theta: Any = (-math.pi, math.pi)
    alpha_speed: Any = 2.0
    beta_speed: Any = 90.0
    theta_speed: Any = 0.8
    alpha_acceleration: Any = math.inf
    beta_acceleration: Any = math.inf
    theta_acceleration: Any = math.inf
    carriage_gap: float | None = None

    def __post_init__(self) -> None:
        for f in fields(self):
            object.__setattr__(self, f.name, unchanging(getattr(self, f.name)))
