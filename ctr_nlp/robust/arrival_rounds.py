"""Arrival of most simulated robots: those that fail join the scenarios, and the motion is planned again.

Scenarios have the mean and the covariance of the tolerances, so that the objective is a mean over robots. Some
robots may still miss the target's end or press into the wall. As in a cutting-set method (Mutapcic and Boyd,
Cutting-set methods for robust convex optimization, Optimization Methods and Software 24(3), 2009), samples that
fail are added as scenarios until few do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ctr_nlp.models import Model
from ctr_nlp.ocp.settings import Settings
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.walls import WallGeometry
from ctr_nlp.plan.monte_carlo import clearances
from ctr_nlp.plan.sample_motions import simulate_samples
from ctr_nlp.plan.sample_outcomes import SampleOutcomes, sample_contact_allowed
from ctr_nlp.robot.samples import RobotSamples, sample_robots
from ctr_nlp.robust.rounds import FailingSamples, FailureJudge, Round, replan_for_failures, solve_with_scenarios
from ctr_nlp.robust.trials import CERTIFICATION_SAMPLES, MAX_JOINING_SAMPLES, TRIAL_SAMPLES_PER_BATCH
from ctr_nlp.typing import Array, Flags

MAX_ARRIVAL_ROUNDS = 3
"""Largest number of times that a motion is re-planned for robots that fail."""
MIN_HOLDING_SHARE = 0.8
"""Share of robots that must pass at first. With less, the robot cannot do both: the trade-off is reported."""
ARRIVAL_FIRST_SAMPLE_SEED = 2**41
"""First seed of the samples; trials for lost robots (trials.py) count from 2**40, so that none are shared."""


@dataclass(frozen=True)
class ArrivalJudge:
    """Checks on samples whether the tip arrives and the body keeps off the wall.

    Attributes
    ----------
    problem : Problem
        Robot with its tolerances, target and lumen.
    model : Model
        Model on which robots are simulated.
    settings : Settings
        `arrival_tolerance` and `contact_allowed`, mm; the wall counts where `contact_weight` does.
    """

    problem: Problem
    model: Model
    settings: Settings

    def __call__(self, q: Array, number: int) -> FailingSamples:
        """Simulate fresh samples on a motion and return those that fail.

        Parameters
        ----------
        q : ndarray
            Configurations (T, 2d + 2), rad and mm.
        number : int
            Number of the motion; each has samples of its own.

        Returns
        -------
        FailingSamples
            Those that miss the target's end or press into the wall, the largest excess over the limit first.
        """
        robot = self.problem.robot
        # Each motion has samples of its own: the last ones have been planned for, and would bias the result.
        draws = sample_robots(robot, CERTIFICATION_SAMPLES, ARRIVAL_FIRST_SAMPLE_SEED + number)
        groups = [
            self._simulate_outcomes(q, draws[first : first + TRIAL_SAMPLES_PER_BATCH])
            for first in range(0, CERTIFICATION_SAMPLES, TRIAL_SAMPLES_PER_BATCH)
        ]
        lost, tip_error, contact = (np.concatenate(each) for each in zip(*groups, strict=True))
        fate = SampleOutcomes(
            lost,
            tip_error,
            contact,
            self.settings.arrival_tolerance,
            sample_contact_allowed(self.settings.contact_allowed),
            self._wall is not None,
        )
        # The larger of both, mm; fmax ignores the contact that is NaN without a wall.
        excess = np.fmax(tip_error - fate.arrival_tolerance, contact - fate.contact_allowed)
        # Robots that leave the branch are handled by rounds.py; here those count that stay on it and still fail.
        failing = np.flatnonzero(~fate.passed_all_checks & ~lost & np.isfinite(excess))
        chosen = draws[failing[np.argsort(-excess[failing])]]
        return FailingSamples(chosen.numbers, chosen.offsets, chosen.forces, fate.share)

    @property
    def _wall(self) -> WallGeometry | None:
        """The wall that counts; None where there is none or contact costs nothing."""
        return self.problem.wall if self.settings.contact_weight else None

    def _simulate_outcomes(self, q: Array, draws: RobotSamples) -> tuple[Flags, Array, Array]:
        """Simulate n samples on q (T, 2d + 2); return for each whether it is lost, its tip error and contact, mm.

        The tip error is the distance from the target's end in the last frame, the contact the deepest of all.
        """
        problem = self.problem
        wall = self._wall
        found = simulate_samples(problem.robot, draws, q, self.model)
        # Only the last tip counts as arrival; its place is that of the shape's last sample.
        tip_error = np.linalg.norm(found.shape[:, -1, -1] - problem.target_frames[-1].points[-1], axis=-1)
        contact = np.full(len(draws), np.nan)
        if wall is not None:
            beta = q[:, problem.robot.d : 2 * problem.robot.d]
            # Least clearance over all frames; fmin ignores frames that are NaN. Negative clearance is depth.
            contact = np.maximum(-np.fmin.reduce(clearances(problem.robot, wall, beta, found.shape), axis=1), 0.0)
        return found.lost > 0, tip_error, contact


def improve_arrival(best: Round, purpose: ArrivalJudge, lost: FailureJudge, number: int) -> list[Round]:
    """Re-plan a motion for robots that do not arrive or press into the wall, until few of them do.

    Parameters
    ----------
    best : Round
        A round over all frames with few lost robots, that `purpose` has evaluated.
    purpose : ArrivalJudge
        Finds the robots that fail.
    lost : callable
        Finds the robots that are lost on a motion; called for every motion.
    number : int
        Number of the first new motion; they count on from there.

    Returns
    -------
    list of Round
        The new rounds, from at most MAX_ARRIVAL_ROUNDS re-plannings.
    """
    search = best.search
    last = best
    rounds = list[Round]()
    # A cutting-set method: the worst constraints that samples show are added, and the program is solved again. It
    # ends where few fail, where so many do that no motion will help, or where robots are lost again.
    for _ in range(MAX_ARRIVAL_ROUNDS):
        found = last.failing
        assert found is not None
        if found.enough or found.holding_share < MIN_HOLDING_SHARE or last.rank > best.rank or search.stop():
            break
        numbers, offsets, forces = (
            each[:MAX_JOINING_SAMPLES] for each in (found.numbers, found.offsets, found.forces)
        )
        # With weight 1 they count as the scenarios of the design do: their shapes are to be near the target, too.
        scenarios = last.scenarios.append_robots(numbers, offsets, forces, weight=1.0)
        tried = solve_with_scenarios(search, last.tried, scenarios)
        if not tried.is_shared:
            break
        # Robots that were stable before may be lost on the new motion: one more round for these.
        more = replan_for_failures(search, tried, scenarios, lost, 1, number + len(rounds))
        asked = number + len(rounds) + len(more)
        last = more[-1]._replace(failing=purpose(more[-1].tried.solution.q, asked))
        rounds += [*more[:-1], last]
    return rounds
