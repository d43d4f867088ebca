"""What keeps a robot from the end of its path: the constraints that are active where the motion ends."""

from __future__ import annotations

import numpy as np

from ctr_nlp.plan.measures import find_deepest_point, rate_parts
from ctr_nlp.plan.metrics import BINDS
from ctr_nlp.plan.plan import Plan

TOUCHING_MM = 0.05
"""Clearance below which a robot counts as touching the wall."""
AT_LIMIT_RAD_OR_MM = 0.01
"""Distance from a limit within which it counts as active."""
USED_SPEED = 0.999
"""Part of the largest speed from which it counts as active."""


def find_binding(plan: Plan) -> list[str]:
    """Find the constraints that are active where a motion ends.

    Parameters
    ----------
    plan : Plan
        The plan.

    Returns
    -------
    list of str
        Of ``"wall"``, ``"stability"``, limits of tubes, such as ``"length of tube 3"``, of their order, of the
        tilt and of the speed; ``["curvature"]`` where none is active, since then only the shapes of the tubes
        keep the robot from its target. Empty where the last frame has no configuration.
    """
    q = plan.q[-1]
    if not np.isfinite(q).all():
        return []
    robot = plan.robot
    found = []
    if plan.clearance is not None and np.nanmin(plan.clearance[-1]) < TOUCHING_MM:
        found.append("wall")
    margin = plan.options.get("stability_margin")
    # NaN, where the model knows no margins, is not below.
    if margin is not None and plan.stability[-1] < margin + BINDS:
        found.append("stability")
    upper = np.append(robot.split(robot.upper)[1][:-1], robot.reach)
    beta = plan.beta[-1]
    found += [f"length of tube {k + 1}" for k in np.flatnonzero(beta > upper - AT_LIMIT_RAD_OR_MM)]
    drawn_back = beta < robot.split(robot.lower)[1] + AT_LIMIT_RAD_OR_MM
    # Tubes that are drawn back as far as they go are in order by their lower limits.
    meet = (np.diff(beta) < AT_LIMIT_RAD_OR_MM) & ~drawn_back[1:]
    found += [f"order of tubes {k + 1} and {k + 2}" for k in np.flatnonzero(meet)]
    ends = np.minimum(q - robot.lower, robot.upper - q)[-2:]
    if ((ends < AT_LIMIT_RAD_OR_MM) & (robot.lower[-2:] < robot.upper[-2:])).any():
        found.append("tilt")
    if len(plan.time) > 1 and rate_parts(plan, 1)[-1].max() > USED_SPEED:
        found.append("speed")
    return found or ["curvature"]


def describe_end(plan: Plan) -> dict[str, float | str]:
    """Describe how a motion ends, as columns of a study's row.

    Parameters
    ----------
    plan : Plan
        The plan.

    Returns
    -------
    dict
        ``binds``: the active constraints, joined by commas; where a wall is known, ``contact_frame``,
        ``contact_along`` (mm along the robot), and ``contact_x``, ``contact_y``, ``contact_z`` (mm in the file's
        coordinates) of the deepest point.
    """
    columns: dict[str, float | str] = {"binds": ", ".join(find_binding(plan))}
    deepest = find_deepest_point(plan)
    if deepest is not None:
        columns |= {"contact_frame": deepest.frame, "contact_along": deepest.arc_length}
        columns |= {f"contact_{axis}": float(x) for axis, x in zip("xyz", deepest.point, strict=True)}
    return columns
