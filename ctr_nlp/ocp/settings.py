"""Numbers a user may set for a frame formulation, and the thresholds by which plans are judged."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.value_checks import number, strict_json, whole_number

ARRIVAL_WEIGHT = 50.0
"""Default of arrival_weight on a model that can predict snapping, mm^2 a mm."""
THRESHOLDS_MM = "arrival_tolerance", "error_allowed", "contact_allowed"
"""Settings in mm by which plans are judged."""
THRESHOLDS = *THRESHOLDS_MM, "share"
"""All settings by which plans are judged; a plan can be judged by other thresholds without planning it again."""


@dataclass(frozen=True)
class Settings:
    """Options of the formulations, and the thresholds by which plans are judged.

    Attributes
    ----------
    motion_weight : float
        lambda of eq. (9), s^2. With the default and 0.1 s a frame, a step of 1 mm costs as much as a shape error
        of 0.01 mm.
    jump_width : float
        Width of the smoothed jumps of curvature in the two-stage formulation, mm, reached from wider ones by
        continuation.
    seed : int
        Seed of the random initial guesses, in [0, 2^32).
    stability_margin : float or None
        Least stability margin of a configuration on the elastic model, from 1 (no tube acts on another) down to 0
        (snap); None for any.
    clearance : float
        Least distance between tubes and the lumen's wall where that is known, mm.
    contact_weight : float
        Cost of a mm less of it in a frame, mm^2, as an exact penalty (ocp.terms.lumen). Each mm beyond
        `contact_allowed` costs twenty times as much: more than the tip's arrival, which costs more than the
        shape's error. 0: the wall does not count.
    arrival_weight : float or None
        Cost of a mm by which the tip misses the target's end in each frame of the last tenth of a motion,
        mm^2; beyond `arrival_tolerance` three times as much (ocp.terms.arrival). 0: the end counts no
        more than other frames. None: ARRIVAL_WEIGHT on a model that can predict snapping, and 0 on others, so that
        the paper's experiments stay what they were.
    arrival_tolerance : float
        A plan arrives where its tip ends at most so far from the target's end, mm. Planning aims at less than a
        fifth of it.
    error_allowed : float
        A plan follows its target where e2 is at most this in every frame, mm.
    contact_allowed : float
        A plan is within the wall where no point of the robot is further beyond it, mm: tissue yields a little.
    share : float
        Share of the simulated robots that must satisfy the tolerances, in (0, 1].

    Raises
    ------
    OptionError
        An option is out of its range.

    Examples
    --------
    >>> Settings(arrival_tolerance=1.0).arrival_tolerance
    1.0
    """

    motion_weight: float = 1e-6
    jump_width: float = 1.5
    seed: int = 0
    stability_margin: float | None = 0.1
    clearance: float = 0.05
    contact_weight: float = 30.0
    arrival_weight: float | None = None
    arrival_tolerance: float = 2.0
    error_allowed: float = 2.0
    contact_allowed: float = 0.5
    share: float = 0.95

    def __post_init__(self) -> None:
        check_motion_weight(self.motion_weight)
        number(
            OptionError, "jump_width", self.jump_width, lambda x: 0 < x < math.inf, "be a finite number > 0", " mm"
        )
        if whole_number(OptionError, "seed", self.seed, 0) >= 2**32:
            raise OptionError(f"seed is {self.seed}; it must be a whole number in [0, 2^32)")
        # At a margin of 1 no tube could act on another.
        if self.stability_margin is not None:
            allowed = "lie in [0, 1), or be None"
            number(OptionError, "stability_margin", self.stability_margin, lambda x: 0 <= x < 1, allowed)
        for name in ("clearance", "contact_weight", "arrival_weight", *THRESHOLDS_MM):
            if name == "arrival_weight" and self.arrival_weight is None:
                continue
            number(OptionError, name, getattr(self, name), lambda x: 0 <= x < math.inf, "be a finite number >= 0")
        number(OptionError, "share", self.share, lambda x: 0 < x <= 1, "lie in (0, 1]")

    def options(self) -> dict[str, Any]:
        """Return the settings in the form of a plan's metadata.

        Returns
        -------
        dict
            Weights, margins and numbers of samples by name, fit for strict JSON.
        """
        found: dict[str, Any] = strict_json(asdict(self))
        return found


def check_motion_weight(weight: float) -> float:
    """Return the weight lambda of eq. (9) in s^2, or raise OptionError."""
    return number(
        OptionError, "motion_weight", weight, lambda x: 0 <= x < math.inf, "be a finite number >= 0", " s^2"
    )
