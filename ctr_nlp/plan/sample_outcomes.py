"""Outcome of each simulated robot: whether it stays on its branch, arrives, and keeps off the wall."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.plan.measures import describe_shortcut
from ctr_nlp.plan.plan_data import PlanData
from ctr_nlp.plan.robustness import spread
from ctr_nlp.typing import Array, Flags

SAMPLE_CONTACT_ALLOWED_MM = 1.0
"""Allowed contact depth of a simulated robot. The nominal robot has less (``contact_allowed``): tolerances move a
robot by some tenths of a millimetre, and tissue gives by that much."""


@dataclass(frozen=True, eq=False)
class SampleOutcomes:
    """Outcomes of n simulated robots.

    Attributes
    ----------
    lost : (n,) bool
        The robot snaps, has no equilibrium, or is on another branch than the nominal robot.
    tip_error : (n,) float
        Distance in mm of the tip from the target's end in the last frame; NaN without an equilibrium.
    contact : (n,) float
        Deepest contact with the wall over all frames, mm, 0 where it touches nothing; NaN without a wall.
    arrival_tolerance, contact_allowed : float
        The limits for the robots, mm.
    wall_known : bool
        Whether a wall is known.
    shortcut : str or None
        How the nominal robot reaches the target's end by another way than along the path; then no robot arrives.
    """

    lost: Flags
    tip_error: Array
    contact: Array
    arrival_tolerance: float
    contact_allowed: float
    wall_known: bool
    shortcut: str | None = None

    def __len__(self) -> int:
        return len(self.lost)

    @property
    def missed_target(self) -> Flags:
        """Mask (n,) of the robots that do not arrive: too far from the target's end, or not along the path."""
        # Negated, so that NaN, a robot without an equilibrium, counts as missed; likewise below.
        return np.asarray(~(self.tip_error <= self.arrival_tolerance) | (self.shortcut is not None))

    @property
    def exceeded_contact_limit(self) -> Flags:
        """Mask (n,) of the robots that press too deep into the wall; all False where no wall is known."""
        return np.asarray(~(self.contact <= self.contact_allowed) & self.wall_known)

    @property
    def passed_all_checks(self) -> Flags:
        """Mask (n,) of the robots that pass all three checks."""
        return np.asarray(~(self.lost | self.missed_target | self.exceeded_contact_limit))

    @property
    def share(self) -> float:
        """Share of the robots that pass all checks."""
        return float(self.passed_all_checks.mean())


def sample_contact_allowed(contact_allowed: float) -> float:
    """Return the contact depth allowed to simulated robots; contact_allowed: that of the nominal one; both mm."""
    return max(SAMPLE_CONTACT_ALLOWED_MM, contact_allowed)


def sample_outcomes(plan: PlanData) -> SampleOutcomes:
    """Evaluate the simulated robots of a plan by the thresholds among its options.

    The last tip of every robot is the last point of its last stored shape (``draws_cloud``), so that plans which
    were saved before arrival was checked can be checked, too.

    Parameters
    ----------
    plan : PlanData
        A plan with samples (:meth:`Plan.with_samples`).

    Returns
    -------
    SampleOutcomes
        Of all its samples.

    Raises
    ------
    OptionError
        The plan has no samples.
    """
    drawn = plan.drawn
    if drawn is None:
        raise OptionError("the plan has no samples; call plan.check() to simulate some")
    asked = Settings().options() | plan.options
    tips = drawn.cloud[-1, :, -1].astype(float)
    return SampleOutcomes(
        lost=drawn.lost > 0,
        tip_error=np.linalg.norm(tips - plan.target[-1, -1], axis=-1),
        contact=np.maximum(-drawn.clearance, 0.0),
        arrival_tolerance=float(asked["arrival_tolerance"]),
        contact_allowed=sample_contact_allowed(float(asked["contact_allowed"])),
        wall_known=plan.wall is not None,
        shortcut=describe_shortcut(plan, float(asked["arrival_tolerance"])),
    )


def sample_summary(plan: PlanData) -> dict[str, Any]:
    """Count the outcomes of a plan's simulated robots, for summary.json.

    Parameters
    ----------
    plan : PlanData
        A plan with samples.

    Returns
    -------
    dict
        ``held``, ``missed`` and ``pressed``: how many robots pass all checks, do not arrive, and press too deep
        into the wall (one robot may count in several); ``held_share``; ``tip_last`` and ``contact_deepest``: mean,
        median and 95 % quantile over the robots in mm, None where nothing is known.
    """
    found = sample_outcomes(plan)
    spreads = {"tip_last": spread(found.tip_error), "contact_deepest": spread(found.contact)}
    return {
        "held": int(found.passed_all_checks.sum()),
        "held_share": found.share,
        "missed": int(found.missed_target.sum()),
        "pressed": int(found.exceeded_contact_limit.sum()),
        **{name: None if each is None else each._asdict() for name, each in spreads.items()},
    }
