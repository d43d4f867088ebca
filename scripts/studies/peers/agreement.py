"""Agreement of another laboratory's forward model with the elastic one, over random configurations."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models import KINEMATIC_MODELS, Model, model_with_load
from ctr_nlp.models.loads import Load
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import whole_number
from ctr_nlp.typing import Array
from peers.program import format_input, run_peer_program

ELASTIC_MODEL = KINEMATIC_MODELS["elastic"]
DIFFERENT_EQUILIBRIUM_DISTANCE_MM = 5.0
"""Distance of two tips, mm, beyond which the models are taken to be in different equilibria."""
EXTENSION_ROUNDING_MM = 0.01
"""Extensions are multiples of this length, mm, since some models round lengths."""
MIN_SAMPLED_EXTENSION_FRACTION, MIN_TUBE_TIP_SPACING_MM = 0.1, 2.0
"""Least extension of a tube relative to its range, and least distance of the tubes' tips, mm: some models
differentiate over a millimetre.
"""


@dataclass(frozen=True)
class Agreement:
    """Comparison of a peer's model with ours over random configurations.

    force_N: norm of the tip force. unsolved, unsolved_here: configurations that the peer, or ours, did not solve.
    elsewhere: solved by both, in different equilibria. tip_*, shape_*: distances of all others, mm: of tips, and
    the largest along the shape at equal arc length. unstable: of the same equilibria, those that the peer calls
    unstable, which ours never are; None where it has no measure. peer_ms, ours_ms: median time of a solution.
    """

    peer: str
    force_N: float
    configurations: int
    unsolved: int
    unsolved_here: int
    elsewhere: int
    tip_median: float
    tip_95: float
    tip_largest: float
    shape_median: float
    shape_largest: float
    unstable: int | None
    peer_ms: float
    ours_ms: float


def sample_configurations(robot: Robot, count: int, seed: int = 0) -> Array:
    """Sample configurations q (count, 2d + 2) without tilt: alpha uniform in (-pi, pi), beta within its limits.

    robot: whose limits and order of tubes are kept. seed: of numpy's default generator. Raises OptionError where
    count is not a whole number of at least 1.
    """
    whole_number(OptionError, "configurations", count, 1)
    rng = np.random.default_rng(seed)
    d = robot.d
    q = np.zeros((count, 2 * d + 2))
    q[:, :d] = rng.uniform(-np.pi, np.pi, (count, d))
    low = robot.lower[d : 2 * d]
    high = robot.upper[d : 2 * d]
    beta = low + (high - low) * rng.uniform(MIN_SAMPLED_EXTENSION_FRACTION, 1.0, (count, d))
    for i in range(1, d):
        beta[:, i] = np.minimum(np.maximum(beta[:, i], beta[:, i - 1] + MIN_TUBE_TIP_SPACING_MM), high[i])
    q[:, d : 2 * d] = np.round(beta / EXTENSION_ROUNDING_MM) * EXTENSION_ROUNDING_MM
    return q


def compare_models(
    name: str,
    program: str | Path,
    robot: Robot,
    q: Array,
    force: Sequence[float] = (0.0, 0.0, 0.0),
) -> Agreement:
    """Compare a peer's program with the elastic model at configurations q (n, 2d + 2).

    name: of the peer. program: path of its executable, see program.py. robot: of both. force: (3,), at the tip, N,
    in the base frame. Ours is the equilibrium that is reached by turning the tubes from where all are aligned.
    Raises OptionError, and LoadError where there is a force and the robot has no moduli.
    """
    model = model_with_load(ELASTIC_MODEL, Load(force=tuple(force))) if np.any(force) else ELASTIC_MODEL
    said = run_peer_program(program, format_input(robot, q, force), len(q))
    ours = [_solve_ours(model, robot, row, answer.arc_length) for row, answer in zip(q, said, strict=True)]
    away = [_distances(answer.points, points) for answer, (points, _) in zip(said, ours, strict=True)]
    # Several equilibria may exist, and models need not reach the same one: that is no disagreement of the models.
    # Tips in different ones are far from each other.
    same = [
        k
        for k, distances in enumerate(away)
        if len(distances) and distances[-1] < DIFFERENT_EQUILIBRIUM_DISTANCE_MM
    ]
    tips = np.array([away[k][-1] for k in same] or [np.nan])
    shapes = np.array([away[k].max() for k in same] or [np.nan])
    median, most, largest = np.quantile(tips, (0.5, 0.95, 1.0)).tolist()
    judged = [said[k].stability for k in same if np.isfinite(said[k].stability)]
    return Agreement(
        name,
        float(np.linalg.norm(force)),
        len(q),
        sum(not len(answer.points) for answer in said),
        sum(not np.isfinite(points).all() for points, _ in ours),
        sum(len(distances) > 0 for distances in away) - len(same),
        median,
        most,
        largest,
        float(np.median(shapes)),
        float(shapes.max()),
        sum(each <= 0 for each in judged) if judged else None,
        1e3 * float(np.median([answer.seconds for answer in said])),
        1e3 * float(np.median([seconds for _, seconds in ours])),
    )


def _solve_ours(model: Model, robot: Robot, q: Array, arc_length: Array) -> tuple[Array, float]:
    """Return points (m, 3) of our model at arc lengths (m,), mm, and the seconds that shape and margin took.

    q: (2d + 2,). Without arc lengths, the point is the tip.
    """
    sigma = np.clip(arc_length / q[2 * robot.d - 1], 0.0, 1.0) if len(arc_length) else np.ones(1)
    begin = time.perf_counter()
    found = model.rest_states(robot, q[None], sigma)
    return found.points[0], time.perf_counter() - begin


def _distances(peer: Array, ours: Array) -> Array:
    """Return distances (m,) between two shapes (m, 3), mm; an empty array where either is not solved."""
    both = len(peer) > 0 and np.isfinite(ours).all()
    return np.linalg.norm(peer - ours, axis=1) if both else np.zeros(0)
