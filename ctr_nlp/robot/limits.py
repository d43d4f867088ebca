"""The limits of a robot's motors, as a user describes them."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

from ctr_nlp.support.packing import packable
from ctr_nlp.support.value_checks import to_nested_tuples


@packable("limits")
@dataclass(frozen=True)
class Limits:
    """Limits of a robot's motors: position, speed and acceleration of alpha, beta and theta.

    Positions are a pair (lower, upper), or one pair a tube (of theta: one for x, one for y). Speeds and
    accelerations are one number, or one a tube. Lists and arrays are stored as tuples. Values are checked by the
    :class:`Robot` that they belong to.

    Steering frame by frame satisfies positions and speeds; the part of the acceleration limit that a plan uses is
    in its summary (``acceleration_used``, more than 1 where it is exceeded).

    Attributes
    ----------
    alpha : pair or sequence of pairs
        Rotation of the tubes, rad; no limit by default.
    beta : pair or sequence of pairs or None
        Extension of the tubes beyond the insertion point, mm, the gamma of eq. (3); by default [0, curved_length]
        of each tube, and [0, length] of a straight one.
    theta : pair or sequence of pairs
        Tilt of the base about x and y, rad.
    alpha_speed, beta_speed, theta_speed : float or sequence of float
        Largest speeds, rad/s and mm/s. The defaults are 0.2 rad, 9 mm and 0.08 rad a frame for 100 frames in 10 s.
    alpha_acceleration, beta_acceleration, theta_acceleration : float or sequence of float
        Largest accelerations, rad/s^2 and mm/s^2; no limit by default.
    carriage_gap : float or None
        Least distance (L_{i+1} - beta_{i+1}) - (L_i - beta_i) between neighbouring carriages, mm; no limit by
        default.

    Examples
    --------
    >>> from ctr_nlp.robot import table_i_robot
    >>> slow = table_i_robot().with_limits(beta_speed=20.0)
    >>> slow.limits.beta_speed, slow.limits.theta_speed
    (20.0, 0.8)
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
            # Tuples instead of lists and arrays make limits hashable and comparable; frozen dataclasses are set
            # this way only.
            object.__setattr__(self, f.name, to_nested_tuples(getattr(self, f.name)))
