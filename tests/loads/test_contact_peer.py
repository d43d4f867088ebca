"""Equilibria on a wall that gives, beside those of PyElastica's rods (elastica_truth.py)."""

from __future__ import annotations

import numpy as np
import pytest
from contact_truth import Bend, Cylinder, Plane

from ctr_nlp import Limits, Load, Robot, Tube
from ctr_nlp.loads.contact_equilibria import ContactEquilibria
from ctr_nlp.loads.contact_rods import ContactStates
from ctr_nlp.loads.winkler_wall import WinklerWall
from ctr_nlp.models.loads import with_modulus
from ctr_nlp.paths.lumen import Lumen
from ctr_nlp.paths.target import SIGMA_GRID

pytest.importorskip("elastica", reason="needs PyElastica: pip install ctr_nlp[peers]")
from elastica_truth import solve_rod

PLANE_RADIUS_MM = 1e5
RIGID_IN_TWIST = -0.999
"""Poisson's ratio of tubes that hardly twist: their torsional
stiffness is a thousand times that against bending."""
SHORT_SCENE = 6
"""A scene that is solved within two seconds."""
SCENES = sorted(set(range(54)) - {10, 31, 42, 43})
"""Fifty scenes; in the four that are left out the robot does not touch the wall."""
KINDS = ("plane", "lumen in the robot's plane", "lumen")


def random_robot(rng, planar):
    """A robot of one to three tubes with one angle, which are inserted as a whole; the curved part of a single one
    ends before its base."""
    d = int(rng.integers(1, 4))
    beta = np.sort(rng.uniform(30, 90, d)) + 10 * np.arange(d)
    outer = np.array([2.4, 1.6, 1.0])[-d:] * rng.uniform(0.9, 1.1)
    curved = beta * rng.uniform(0.5, 0.9) if d == 1 else beta
    tubes = tuple(
        Tube(
            float(out),
            float(bent),
            float(rng.uniform(0.004, 0.012)),
            float(each),
            float(each - 0.45),
            # In a plane tubes do not turn against each other; elsewhere they must not.
            poisson_ratio=0.3 if planar or d == 1 else RIGID_IN_TWIST,
        )
        for out, bent, each in zip(beta, curved, outer, strict=True)
    )
    # Limits say how far a tube may come out: without them, as far as it is curved.
    limits = Limits(beta=[(1.0, float(out)) for out in beta])
    return with_modulus(Robot(tubes, limits), 60_000), beta


def random_scene(seed):
    """A robot, its configuration, and both descriptions of a wall that it leans on."""
    kind = KINDS[seed % 3]
    rng = np.random.default_rng(seed)
    robot, beta = random_robot(rng, kind != "lumen")
    alpha = rng.uniform(-np.pi, np.pi)
    tilt = rng.uniform(-0.1, 0.1, 2) * (kind == "lumen")
    q = np.concatenate([np.full(robot.d, alpha), beta, tilt])
    stiffness = float(10 ** rng.uniform(-2, -0.5))
    bends = np.array([np.cos(alpha), np.sin(alpha), 0.0])
    z = np.array([0.0, 0.0, 1.0])
    s = np.linspace(-20.0, 200.0, 881)
    if kind == "plane":
        lean, offset = rng.uniform(-0.2, 0.2), float(rng.uniform(2.0, 8.0))
        normal = np.cos(lean) * bends + np.sin(lean) * z
        along = np.cos(lean) * z - np.sin(lean) * bends
        path = (offset - PLANE_RADIUS_MM) * normal + s[:, None] * along
        radii = np.full(len(s), PLANE_RADIUS_MM)
        return robot, q, Plane(normal, offset, stiffness), Lumen(np.column_stack([path, radii])), stiffness
    radius = float(rng.uniform(2.5, 6.0))
    radii = np.full(len(s), radius)
    towards = alpha if kind != "lumen" else rng.uniform(-np.pi, np.pi)
    side = np.array([np.cos(towards), np.sin(towards), 0.0])
    if rng.random() < 0.5:
        direction = z + rng.uniform(-0.15, 0.15) * side
        path = s[:, None] * direction / np.linalg.norm(direction)
        return (
            robot,
            q,
            Cylinder(np.zeros(3), direction, radius, stiffness),
            Lumen(np.column_stack([path, radii])),
            stiffness,
        )
    bend = float(rng.uniform(60, 150))
    path = bend * ((1 - np.cos(s / bend))[:, None] * side + np.sin(s / bend)[:, None] * z)
    return robot, q, Bend(bend, towards, radius, stiffness), Lumen(np.column_stack([path, radii])), stiffness


def check_scene(seed):
    """Compare the shape within 0.2 mm and the total force within 5 %."""
    robot, q, wall, lumen, stiffness = random_scene(seed)
    equilibria = ContactEquilibria(robot, WinklerWall(lumen, stiffness), Load())
    state = equilibria.place(q, Load().numbers(robot.d))
    assert state is not None
    points, force = solve_rod(robot, q, wall)
    assert force > 0
    length = q[2 * robot.d - 1]
    apart = np.linalg.norm(equilibria.shape(state, SIGMA_GRID) - points(SIGMA_GRID * length), axis=1)
    assert apart.max() < 0.2
    assert equilibria.forces(ContactStates.stack([state])).force.sum() == pytest.approx(force, rel=0.05)


def test_a_random_scene_is_that_of_pyelastica():
    check_scene(SHORT_SCENE)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [seed for seed in SCENES if seed != SHORT_SCENE])
def test_fifty_random_scenes_are_those_of_pyelastica(seed):
    check_scene(seed)
