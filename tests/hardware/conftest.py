"""What tests of playing share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from ctr_nlp.hardware.description import Hardware
from ctr_nlp.hardware.motion.trajectory import Trajectory, digests, trajectory_of
from ctr_nlp.hardware.playing import session
from ctr_nlp.hardware.playing.checks import TrajectoryCheck, check_trajectory
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array


@pytest.fixture(scope="module")
def prepared_once() -> Iterator[None]:
    """The trajectory of a plan on some hardware is made and checked once; what plays it is made anew each time."""
    known: dict[object, Trajectory] = {}

    def made(
        plan: Plan, hardware: Hardware, tempo: float = 1.0, standing: Array | None = None, share: float = 1.0
    ) -> Trajectory:
        key = digests(plan, hardware), repr(tempo), None if standing is None else standing.tobytes(), share
        if key not in known:
            known[key] = trajectory_of(plan, hardware, tempo, standing, share)
        return known[key]

    looked_at: dict[tuple[int, str | None], TrajectoryCheck] = {}

    def found(trajectory: Trajectory, model: str | None = None) -> TrajectoryCheck:
        if not any(each is trajectory for each in known.values()):
            return check_trajectory(trajectory, model)
        key = id(trajectory), model
        if key not in looked_at:
            looked_at[key] = check_trajectory(trajectory, model)
        return looked_at[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "trajectory_of", made)
        patch.setattr(session, "check_trajectory", found)
        yield
