"""How tubes twist each other: the torsionally compliant model (Dupont 2010, Rucker 2010), unloaded, frictionless.

Its unknowns are x = (phi, beta, theta) in rad and mm: phi_d is the angle psi_d of the innermost tube at its tip,
and phi_i that of tube i at its own, less phi_d. From the tips, which are untwisted, the balance of moments,

    GJ_i psi_i'' = EI_i k_i u x e(psi_i),   u = sum_i EI_i k_i e(psi_i) / sum_i EI_i,   psi_i'(beta_i) = 0,

is integrated to the base, and on through the straight transmissions to the motors: alpha is an explicit, smooth
function of x, every x is an equilibrium, and there is no equation to solve. alpha alone does not determine x:
where d alpha / d phi is singular, the robot snaps. Here u is the bending vector and k_i the pre-curvature in 1/mm,
e(psi) = (cos psi, sin psi), and a prime is d/ds.

The pre-curvature of a helix turns along the tube, by tau a mm. Its psi is the direction in which it bends, so that
psi_i' = tau_i where it is untwisted; alpha is that direction where its curved part begins, if it is untwisted.

Angles here are relative to phi_d, since turning all tubes turns the whole robot. One source for symbols and
numbers, as in models/dominant/shape.py: `xp` is casadi or numpy.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

from ctr_nlp.robot.structure import Tubes

ELASTIC_STEPS_PER_SECTION = 4
"""Steps of integration a section: angles of motors are good to 3e-5 rad near a fold, shapes to 0.001 mm."""
STAGES = (1 / 5, (1 / 50,)), (2 / 3, (-1 / 27, 7 / 27)), (1.0, (3 / 10, -2 / 35, 9 / 35))
"""Stages of Nystroem's method after the first: the part of the step, and weights of the second derivatives before
it.
"""
OF_ANGLES = 14 / 336, 100 / 336, 54 / 336, 0.0
"""Weights of the second derivatives at the four stages in the change of angles over a step."""
OF_RATES = 14 / 336, 125 / 336, 162 / 336, 35 / 336
"""Weights of the second derivatives at the four stages in the change of rates over a step."""


class RobotSection(NamedTuple):
    """Part of the robot along which the same tubes are present and curved; start and length in mm.

    shares: each tube's part of the bending stiffness of those present. curved: 0 or 1 for every tube. present: the
    tubes that are there; active: those of them that may be curved. plane: whether at most one tube is active, with
    a known share, and is no helix: the section then bends in a plane.
    """

    start: Any
    length: Any
    shares: tuple[Any, ...]
    curved: tuple[Any, ...]
    present: tuple[int, ...]
    active: tuple[int, ...]
    plane: bool

    def split_evenly(self, count: int) -> list[RobotSection]:
        """Divide the section into `count` pieces of equal length, from base to tip."""
        length = self.length / count
        return [self._replace(start=self.start + k * length, length=length) for k in range(count)]


class Node(NamedTuple):
    """A place along the robot: the tubes' angles, rad, and their curvatures, 1/mm (0.0 where not active).

    outside: the bending vector, 1/mm, that a moment from outside adds to that of the tubes.
    """

    angles: list[Any]
    curvatures: list[Any]
    outside: tuple[Any, Any] | None = None


class Twist(NamedTuple):
    """The tubes' angles along the robot.

    nodes: of every section from base to tip; a single one, at its base, in a plane section, else 2 steps + 1,
    evenly spaced. angles, rates: at the base, rad and rad/mm.
    """

    nodes: list[list[Node]]
    angles: list[Any]
    rates: list[Any]


def sections(tubes: Tubes, beta: Sequence[Any], xp: Any, planes: bool = True) -> list[RobotSection]:
    """Divide the robot at tube tips, and where a straight part that can be pushed out begins.

    tubes: of the robot. beta: extensions, mm. xp: casadi or numpy. planes: whether a tube that is alone bends in a
    plane, as without a load; then the last interval, its straight part included, needs no division, unless it is a
    helix.
    """
    d = len(tubes)
    found = list[RobotSection]()
    divided = d - 1 if planes and tubes[-1].kind != "helix" else d
    # Where the curved part of each tube begins, mm from the base, if its straight part can show: 0 while
    # that is hidden.
    starts = [
        xp.fmax(beta[i] - tube.curved_length, 0.0) if tubes[i].transmission_emerges else None
        for i, tube in enumerate(tubes)
    ]
    for i, (low, high) in enumerate(itertools.pairwise([0 * beta[0], *beta])):
        present = (0.0,) * i + (1.0,) * (d - i)
        edges = [low, high]
        for start in starts[i:] if i < divided else ():
            if start is not None:
                # Clamped into every interval, so that there are as many sections wherever starts lie: some
                # have length 0. A program's structure must not depend on its numbers.
                inside = (xp.fmax(a, xp.fmin(b, start)) for a, b in itertools.pairwise(edges))
                edges = [low, *inside, high]
        for a, b in itertools.pairwise(edges):
            # Within a section a tube is curved throughout or not at all; its midpoint decides which.
            curved = [
                here if start is None or i == divided else here * ((a + b) / 2 >= start)
                for here, start in zip(present, starts, strict=True)
            ]
            section = _section(tubes, a, b, present, curved)
            # Several pieces where a helix turns too far for the steps of one section.
            pieces = section.split_evenly(max((tubes[k].pieces for k in section.active), default=1))
            found += pieces if planes else [piece._replace(plane=False) for piece in pieces]
    return found


def _section(tubes: Tubes, a: Any, b: Any, present: Sequence[float], curved: Sequence[Any]) -> RobotSection:
    """The section from a to b (mm) with the tubes present and curved, each 0 or 1 for every tube."""
    stiffness = [here * tube.bending_stiffness for here, tube in zip(present, tubes, strict=True)]
    shares = tuple(EI / sum(stiffness) for EI in stiffness)
    there = tuple(i for i, here in enumerate(present) if here)
    active = tuple(i for i in there if tubes[i].kind != "straight")
    # A tube alone has no other to twist it: its psi'' is 0. A helix's direction turns nevertheless.
    plane = len(active) <= 1 and all(tubes[i].kind != "helix" for i in active)
    return RobotSection(a, b - a, shares, tuple(curved), there, active, plane)


def twist(
    tubes: Tubes, x: Sequence[Any], parts: Sequence[RobotSection], xp: Any, steps: int = ELASTIC_STEPS_PER_SECTION
) -> Twist:
    """Integrate the tubes' angles from their tips to the base by Nystroem's method of order 5.

    tubes: of the robot. x: its 2d + 2 unknowns, rad and mm. parts: its sections. xp: casadi or numpy. steps: of
    integration in each section. (Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, section
    II.14, table 14.1.)
    """
    d = len(tubes)
    # Untwisted at the tips: psi' is the helix's own torsion, 0 for other tubes.
    rates = [tube.spin for tube in tubes]
    nodes = list[list[Node]]()
    # All tubes start at the robot's tip, beta_d, as if each went on untwisted beyond its own tip: it then
    # arrives at beta_i with phi_i, and no case distinguishes sections with and without it.
    ahead = ((rate, x[2 * d - 1] - beta) for rate, beta in zip(rates, x[d : 2 * d], strict=True))
    angles = [phi + rate * beyond for phi, (rate, beyond) in zip([*x[: d - 1], 0.0], ahead, strict=True)]
    for part in reversed(parts):
        if part.plane:
            # psi'' = 0 in a plane section: angles are linear in s.
            angles = add_scaled_changes(angles, (-part.length, rates))
            nodes.append([Node(angles, curvatures_at(tubes, x, part, part.start))])
            continue
        # Backwards, from the tip to the base.
        h = -part.length / steps
        # Nodes are collected from tip to base, and turned round at the end.
        found = [Node(angles, curvatures_at(tubes, x, part, part.start + part.length))]
        for k in range(steps, 0, -1):
            begin = angles, rates
            ks = [_moments(tubes, part, found[-1], xp)]
            for place, row in STAGES:
                there = curvatures_at(tubes, x, part, part.start + part.length * ((k - place) / steps))
                # Nystroem's stage: y(c h) = y + c h y' + h^2 sum a_j k_j, for y'' = f(s, y) without y'.
                changes = ((h**2 * weight, of) for weight, of in zip(row, ks, strict=True) if weight)
                ks.append(
                    _moments(
                        tubes, part, Node(add_scaled_changes(angles, (h * place, rates), *changes), there), xp
                    )
                )
            angles = add_scaled_changes(
                angles, (h, rates), *((h**2 * w, of) for w, of in zip(OF_ANGLES, ks, strict=True) if w)
            )
            # After the angles, which need the rates at the step's beginning.
            rates = add_scaled_changes(rates, *((h * w, of) for w, of in zip(OF_RATES, ks, strict=True)))
            # Shapes and stability need angles in the middle of steps, too: from an interpolant, not from
            # more stages.
            middle = _between(begin, (angles, rates), (ks[0], ks[-1]), h)
            for part_of_step, at in ((0.5, middle), (1.0, angles)):
                s = part.start + part.length * ((k - part_of_step) / steps)
                found.append(Node(at, curvatures_at(tubes, x, part, s)))
        nodes.append(found[::-1])
    return Twist(nodes[::-1], angles, rates)


def motors(tubes: Tubes, x: Sequence[Any], twisted: Twist) -> list[Any]:
    """Return the angles of the motors (d,), rad: alpha_i = psi_i(0) - psi_i'(0) (L_i - beta_i).

    tubes: of the robot. x: its 2d + 2 unknowns. twisted: the tubes' angles along it.
    """
    d = len(tubes)
    ends = zip(twisted.angles, twisted.rates, tubes, x[d : 2 * d], strict=True)
    return [
        # Nothing bends the straight transmission, so its twist is constant. A helix's direction turns on
        # the hidden part of its curved part, but not on the straight part of length L_i - Lc_i: the last
        # summand takes that back. x[d - 1] is phi_d, which angles are relative to.
        # The sign: s runs from base to tip and the motor is at s = beta_i - L_i < 0, so psi there is psi(0) minus
        # rate times (L_i - beta_i).
        x[d - 1] + angle - rate * (tube.length - beta) + tube.spin * (tube.length - tube.curved_length)
        for angle, rate, tube, beta in ends
    ]


def turned_untwisted(tubes: Tubes, x: Sequence[Any], i: int, s: Any) -> Any:
    """Return the direction in which tube i bends at s (mm), rad, if it is untwisted and its motor is at 0.

    tubes: of the robot. x: its 2d + 2 unknowns, of which the extensions count.
    """
    return tubes[i].spin * (tubes[i].curved_length - x[len(tubes) + i] + s)


def bending(part: RobotSection, node: Node, xp: Any) -> tuple[Any, Any]:
    """Return the bending vector u at a node of a section (part), 1/mm, as x and y: shares times k e(psi), summed.

    The sum is over the active tubes. xp: casadi or numpy.
    """
    here = [(part.shares[i] * node.curvatures[i], node.angles[i]) for i in part.active]
    return sum(k * xp.cos(psi) for k, psi in here), sum(k * xp.sin(psi) for k, psi in here)


def curvatures_at(tubes: Tubes, x: Sequence[Any], part: RobotSection, s: Any) -> list[Any]:
    """Return the pre-curvature of every tube at s (mm) of a section (part), 1/mm; 0.0 where it is not active.

    tubes: of the robot. x: its 2d + 2 unknowns, of which the extensions count.
    """
    found: list[Any] = [0.0] * len(tubes)
    for i in part.active:
        tube = tubes[i]
        # slope is per mm from the tip towards the root, and beta_i - s is the distance from the tip.
        found[i] = part.curved[i] * (tube.tip_curvature + tube.slope * (x[len(tubes) + i] - s))
    return found


def _moments(tubes: Tubes, part: RobotSection, node: Node, xp: Any) -> list[Any]:
    """Return the second derivatives psi'' of every tube at a node of a section, rad/mm^2, from the balance of
    moments.
    """
    (x, y), found = bending(part, node, xp), [0.0] * len(tubes)
    for i in part.active:
        # torsional_ratio is EI / GJ = 1 + Poisson's ratio; u x e(psi) = u_x sin(psi) - u_y cos(psi).
        psi = node.angles[i]
        k = tubes[i].torsional_ratio * node.curvatures[i]
        found[i] = k * (x * xp.sin(psi) - y * xp.cos(psi))
    return found


def _between(begin: Any, end: Any, seconds: Any, h: Any) -> list[Any]:
    """Return the angles halfway through a step h, by the quintic polynomial through both ends.

    begin, end: angles and rates there; seconds: second derivatives at both ends.
    """
    (first, first_rates), (last, last_rates), (a, b) = begin, end, seconds
    # Quintic Hermite at 1/2: (y0 + y1) / 2 + 5 h (y0' - y1') / 32 + h^2 (y0'' + y1'') / 64.
    middle = [(one + other) / 2 for one, other in zip(first, last, strict=True)]
    slopes = (h * 5 / 32, first_rates), (-h * 5 / 32, last_rates)
    return add_scaled_changes(middle, *slopes, (h**2 / 64, a), (h**2 / 64, b))


def add_scaled_changes(values: Sequence[Any], *changes: tuple[Any, Sequence[Any]]) -> list[Any]:
    """Return values plus the sum of factors times changes, entry by entry; changes: pairs (factor, change)."""
    return [value + sum(factor * change[i] for factor, change in changes) for i, value in enumerate(values)]
