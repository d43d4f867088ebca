"""Robots on a wall that gives, by PyElastica's Cosserat rods, which are let go from their free shape and damped to
rest.

A robot whose tubes do not turn against each other is one rod, whose bending stiffness and rest curvature change at
the tubes' ends. PyElastica's rods stretch and shear, and move: they are made stiff against both, and masses are
chosen so that a step of time may be large. Equilibria do not depend on them (dynamic relaxation, Papadrakakis, A
method for the automatic evaluation of the dynamic relaxation parameters, Computer Methods in Applied Mechanics and
Engineering 25, 1981).
"""

from __future__ import annotations

import elastica
import numpy as np

from ctr_nlp import Robot

ELEMENT_LENGTH_MM = 2.5
"""Greatest length of an element, mm."""
PARTS_PER_ELEMENT = 4
"""Parts of an element on each of which the wall's push is taken in the middle."""
STIFFNESS_RATIO_PER_MM2 = 3.0
"""Stiffness against stretching and shearing over that against bending, 1/mm^2: of a solid rod 16 / diameter^2."""
TIME_STEP = 1.2
"""Step of time, where the fastest vibration has the rate 1; from 2 on it would grow."""
RAMP_TIMES, MAX_TIMES = 3.0, 60.0
"""Time in which the wall hardens, and longest time until a rod is at rest, over that of its slowest vibration."""
HARDENING_DECADES = 4.0
"""Powers of ten by which the wall hardens."""
LARGEST_CREEP_MM = 0.01
"""Distance by which unbalanced forces could still move the tip of a rod that counts as being at rest, mm."""


class _Simulator(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing, elastica.Damping):
    """A collection of rods with clamps, forces and damping."""


class _NodeForces:
    """Forces of a wall on the nodes of a rod, N.

    They are integrated on parts of elements, since a tip may touch with less than one element.
    """

    def __init__(self, wall, robot, beta, along):
        """Prepare for nodes at arc lengths along (n,), mm, of a robot with extensions beta (d,), mm."""
        h = along[1] - along[0]
        edges = np.unique(np.concatenate([np.arange(0, beta[-1], h / PARTS_PER_ELEMENT), beta]))
        middle = (edges[1:] + edges[:-1]) / 2
        self.wall, self.lengths = wall, np.diff(edges)
        outermost = (middle[:, None] > beta).sum(axis=1)
        self.radii = np.array([tube.outer_diameter / 2 for tube in robot.tubes])[outermost]
        # Between nodes a rod is straight.
        self.shares = np.maximum(1 - abs(middle[:, None] - along) / h, 0.0)
        self.hardness = 1.0

    def on(self, points):
        """Return the forces (3, m) on all parts, and those (3, n) on nodes at points (3, n), mm."""
        found = self.hardness * self.lengths * self.wall.push(points @ self.shares.T, self.radii)
        return found, found @ self.shares


class _Pushed(elastica.NoForces):
    """A rod on which forces act that depend on where its nodes are."""

    def __init__(self, forces):
        super().__init__()
        self.forces = forces

    def apply_forces(self, system, time=0.0):
        system.external_forces += self.forces.on(system.position_collection)[1]


def _free_rod(robot: Robot, q):
    """Return a rod in the free shape of a robot whose tubes have one angle, at rest, and its compliance at the
    tip.

    The clamp of PyElastica holds the direction of an element, which is that of its middle: the first one reaches
    half of its length behind the opening.
    """
    d = robot.d
    alpha, beta, theta = q[0], q[d : 2 * d], q[2 * d :]
    length = beta[-1]
    count = int(np.ceil(length / ELEMENT_LENGTH_MM + 0.5))
    h = length / (count - 0.5)
    cx, sx, cy, sy = np.cos(theta[0]), np.sin(theta[0]), np.cos(theta[1]), np.sin(theta[1])
    base = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]]) @ np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    # What joins two elements has the mean compliance and the mean rest curvature between their middles.
    s = (np.arange(count - 1)[:, None] + (np.arange(200) + 0.5) / 200) * h
    bending, twisting, pull = np.zeros((3, *s.shape))
    for tube, out in zip(robot.tubes, beta, strict=True):
        present = s < out
        bending += tube.bending_stiffness * present
        twisting += tube.bending_stiffness / (1 + tube.poisson_ratio) * present
        pull += tube.bending_stiffness * tube.tip_curvature * (present & (s > out - tube.curved_length))
    curvature = (pull / bending).mean(axis=1)
    compliance = float((h * (length - s) ** 2 / bending).mean(axis=1).sum())
    bending, twisting = (1 / (1 / each).mean(axis=1) for each in (bending, twisting))
    frames = [base.T]
    for each in curvature:
        d1, d2, t = frames[-1]
        towards = np.cos(alpha) * d1 + np.sin(alpha) * d2
        turned = np.cos(each * h) * t + np.sin(each * h) * towards
        across = np.cross(t, towards)
        inwards = np.cross(across, turned)
        frames.append(
            np.array(
                [
                    np.cos(alpha) * inwards - np.sin(alpha) * across,
                    np.sin(alpha) * inwards + np.cos(alpha) * across,
                    turned,
                ]
            )
        )
    directors = np.moveaxis(np.array(frames), 0, 2)
    steps = np.concatenate([-h / 2 * directors[2, :, :1], h * directors[2]], axis=1)
    rod = elastica.CosseratRod.straight_rod(
        count,
        np.zeros(3),
        base[:, 2],
        base[:, 0].copy(),
        length + h / 2,
        1.0,
        1.0,
        youngs_modulus=1.0,
        shear_modulus=1.0,
        position=np.cumsum(steps, axis=1),
        directors=directors,
    )
    stiff = STIFFNESS_RATIO_PER_MM2 * bending.max()
    rod.rest_kappa[:] = rod.kappa
    rod.bend_matrix[:] = np.stack([bending, bending, twisting])[:, None] * np.eye(3)[..., None]
    rod.shear_matrix[:] = stiff * np.eye(3)[..., None]
    # With these no vibration is faster than 1: 4 K / (m h) of stretching, as much of turning against shear, 4 EI /
    # (J h) of bending, and 4 GJ / (I h) of twist.
    mass = 12 * stiff / h
    turning = mass * (h**2 / 4 + bending.max() / stiff)
    inertia = np.diag([turning, turning, max(turning, 6 * twisting.max() / h)])
    rod.mass[:] = mass
    rod.mass_second_moment_of_inertia[:] = inertia[..., None]
    rod.inv_mass_second_moment_of_inertia[:] = np.linalg.inv(inertia)[..., None]
    # The slowest vibration: a beam has 0.24 of its mass at the tip, as it were.
    rate = 1 / np.sqrt(compliance * 0.24 * mass / h * length)
    return rod, compliance, rate


def solve_rod(robot: Robot, q, wall):
    """Solve for a robot on a wall; its tubes have the angle of the first one and do not turn against each other.

    Returns a function from arc lengths to points, and the sum of the wall's forces' sizes, N.
    """
    d = robot.d
    beta = q[d : 2 * d]
    rod, compliance, rate = _free_rod(robot, q)
    h = float(rod.rest_lengths[0])
    along = (np.arange(rod.n_elems + 1) - 0.5) * h
    forces = _NodeForces(wall, robot, beta, along)
    simulator = _Simulator()
    simulator.append(rod)
    simulator.constrain(rod).using(
        elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
    )
    simulator.add_forcing_to(rod).using(_Pushed, forces)
    simulator.dampen(rod).using(
        elastica.AnalyticalLinearDamper, uniform_damping_constant=2 * rate, time_step=TIME_STEP
    )
    simulator.finalize()
    stepper = elastica.PositionVerlet()
    time, slowest = 0.0, 1 / rate
    ramp = RAMP_TIMES * slowest
    while time < MAX_TIMES * slowest:
        end = time + slowest / 2
        while time < end:
            forces.hardness = 10 ** min(HARDENING_DECADES * (time / ramp - 1), 0.0)
            time = float(stepper.step(simulator, time, TIME_STEP))
        if time > ramp:
            rod.compute_internal_forces_and_torques(time)
            pushes, on_nodes = forces.on(rod.position_collection)
            left = np.linalg.norm((rod.internal_forces + on_nodes)[:, 1:], axis=0).sum()
            turning = np.linalg.norm(rod.internal_torques[:, 1:], axis=0).sum()
            creep = compliance * (left + 1.5 * turning / beta[-1])
            assert np.isfinite(creep), "the rod's motion has become unstable"
            if creep < LARGEST_CREEP_MM:
                break
    else:
        raise AssertionError(f"the rod is not at rest: its tip could move by {creep} mm")

    points = rod.position_collection.copy()
    return (
        lambda s: np.stack([np.interp(s, along, each) for each in points], axis=1),
        float(np.linalg.norm(pushes, axis=0).sum()),
    )
