"""What property tests draw from: robots, configurations and rigid transforms."""

from __future__ import annotations

import numpy as np
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from ctr_nlp import Limits, Robot, Tube

WALL_MM = 0.1
"""Thickness of every drawn tube's wall and, on the radius, half of the room to the next."""


def numbers(low: float, high: float) -> st.SearchStrategy[float]:
    """Finite floats in [low, high], without subnormal ones."""
    return st.floats(low, high, allow_subnormal=False)


def curvatures(varying: bool | None = None) -> st.SearchStrategy[float | tuple[float, float]]:
    """Pre-curvatures in 1/mm: constant, linear from root to tip, of either sign at the root, or (None) either."""
    constant = st.one_of(st.just(0.0), numbers(1e-4, 0.04))
    linear = st.tuples(numbers(-0.04, 0.04), numbers(0, 0.04)).filter(lambda pair: pair[0] >= 0 or pair[1] > 0)
    return {False: constant, True: linear, None: st.one_of(constant, linear)}[varying]


@st.composite
def robots(
    draw: st.DrawFn,
    least: int = 1,
    most: int = 4,
    varying: bool | None = None,
    transmissions: bool | None = None,
) -> Robot:
    """Robots with least to most tubes; transmissions: whether beta may exceed the curved parts (None: either)."""
    d = draw(st.integers(least, most))
    outer = 2 - 4 * WALL_MM * np.arange(d)
    curved = np.cumsum([draw(numbers(10, 45)) for _ in range(d)])
    lengths = np.maximum.accumulate(curved + [draw(numbers(0, 60)) for _ in range(d)])
    tubes = tuple(
        Tube(lengths[i], curved[i], draw(curvatures(varying)), outer[i], outer[i] - 2 * WALL_MM) for i in range(d)
    )
    deploys_all = draw(st.booleans()) if transmissions is None else transmissions
    return Robot(tubes, Limits(beta=[(0, length) for length in lengths]) if deploys_all else Limits())


@st.composite
def configurations(draw: st.DrawFn, robot: Robot, shortest: float = 1.0) -> np.ndarray:
    """Q (2d + 2,) within the robot's limits, beta in order and at least shortest mm at the end."""
    d = robot.d
    q = np.zeros(2 * d + 2)
    q[:d] = [draw(numbers(-7, 7)) for _ in range(d)]
    reached = 0.0
    for i in range(d, 2 * d):
        hidden = draw(st.booleans()) and i < 2 * d - 1
        reached = reached if hidden else max(reached, robot.max_extensions[i - d] * draw(numbers(0, 1)))
        q[i] = reached
    q[2 * d - 1] = max(reached, shortest)
    q[2 * d :] = [draw(numbers(-3.1, 3.1)) for _ in range(2)]
    robot.check(q)
    return q


@st.composite
def robots_with_q(draw: st.DrawFn, **kinds: object) -> tuple[Robot, np.ndarray]:
    """A robot of the given kinds and one of its configurations."""
    robot = draw(robots(**kinds))
    return robot, draw(configurations(robot))


@st.composite
def rigid_transforms(draw: st.DrawFn) -> np.ndarray:
    """Proper rigid transforms (4, 4), shifts within 500 mm."""
    transform = np.eye(4)
    transform[:3, :3] = Rotation.from_rotvec([draw(numbers(-3, 3)) for _ in range(3)]).as_matrix()
    transform[:3, 3] = [draw(numbers(-500, 500)) for _ in range(3)]
    return transform


seeds = st.integers(0, 2**32 - 1)
"""For numpy generators, where a whole array is wanted."""


def drawn(rng, d):
    """A robot of d arcs, each tube longer, thinner and by far less stiff than the one around it."""
    outer, length, curved, tubes = rng.uniform(4.5, 6.5), rng.uniform(80, 120), rng.uniform(40, 60), []
    for _ in range(d):
        inner = outer * rng.uniform(0.72, 0.8)
        curvature = rng.uniform(0.004, min(0.02, 0.03 / outer))
        tubes.append(Tube(length, curved, curvature, outer, inner, rng.uniform(0.25, 0.4)))
        outer, length, curved = (
            inner * rng.uniform(0.75, 0.9),
            length + rng.uniform(70, 150),
            curved + rng.uniform(30, 55),
        )
    return Robot(tuple(tubes))
