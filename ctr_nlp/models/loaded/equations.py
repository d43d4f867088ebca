"""The differential equations of a loaded rod (rod.py) along a section, as changes over a step towards the base.

With the internal force n, N, and moment m, N mm, in the base's directions; a frame (d_1, d_2, t) that does not
spin along the robot; the tubes' angles psi_i, rad, in it; a weight and a force w per length, N/mm:

    n' = -weight - w,   m' = -t x n,   d_1' = -u_1 t,   d_2' = -u_2 t,   t' = u_1 d_1 + u_2 d_2
    u_1 = (m . d_2 + sum EI_i k_i cos psi_i) / sum EI_i,   u_2 = (-m . d_1 + sum EI_i k_i sin psi_i) / sum EI_i
    GJ_i psi_i'' = EI_i k_i u x e(psi_i)

(Rucker, Jones, Webster, IEEE Transactions on Robotics 26(5), 2010.) A state is a list of angles psi, of their
rates psi', and of the entries of d_1, d_2, t and m. A response is the first-order effect of a change at the tip:
on angles and rates, turns (a, b, c) of the frame about d_1, d_2 and t, and on moment and force; on a foundation,
whose w changes with the place, on the place as well. Changes over a
step are slopes times a length h, which is negative towards the base: curvatures, rates and forces are multiplied
by h once, and the rest follows without further products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from ctr_nlp.models.elastic.torsion import RobotSection, curvatures_at
from ctr_nlp.models.loaded.rod_loads import DistributedForce
from ctr_nlp.models.loaded.vectors import cross, dot, plus, scale_vector, vectors
from ctr_nlp.robot.structure import Tubes
from ctr_nlp.typing import Vector

Values = list[Any]


class Softness(NamedTuple):
    """Factors by which torsion and bending are softer in responses than in the rod: 1 / (1 - margin).

    See stability.py.
    """

    torsion: Any = 1.0
    bending: Any = 1.0


class _Here(NamedTuple):
    """A place along a section.

    By active tube: twist, its EI_i k_i / GJ_i, 1/mm; sin and cos of psi_i. Times the length h of the step: pull,
    its EI_i k_i / sum EI_i, by which it bends the robot; flexible, 1 / sum EI_i; about, the moment over sum EI_i
    in the axes d_1, d_2, t; u, which is (u_1, u_2); n, the internal force.
    """

    twist: dict[int, Any]
    sin: dict[int, Any]
    cos: dict[int, Any]
    pull: dict[int, Any]
    flexible: Any
    about: list[Any]
    u: tuple[Any, Any]
    n: Vector


@dataclass(frozen=True)
class Equations:
    """The equations along one section (part) of a rod.

    tubes: with their numbers. beta: extensions, mm. force: internal force at the section's end towards the tip, N,
    without the force along the body. weight: per length, N/mm. growth: half the change of a further force per
    length along the section, whose mean is 0, N/mm, or None. foundation: how the force per length changes with the
    place, or empty; both of rod_loads.PieceForce. along: the force between two places along the body,
    or None. soft: softness of the responses. xp: casadi or numpy. steps: number of steps of integration.
    """

    tubes: Tubes
    beta: Sequence[Any]
    part: RobotSection
    force: Vector
    weight: Vector
    growth: Vector | None
    foundation: Sequence[Vector]
    along: DistributedForce | None
    soft: Softness
    xp: Any
    steps: int

    def changes(self, steps: float, share: float, y: Values, by: Values) -> tuple[Values, Values]:
        """Return the changes of a state y, and of its responses `by` if any, over a share of a step to the base.

        steps: distance of the place from the section's end towards the tip, in steps.
        """
        d = len(self.tubes)
        h = -self.part.length * (share / self.steps)
        here = self._here(steps / self.steps, h, y)
        (u1, u2), (d1, d2, t, _) = here.u, vectors(y[2 * d :])
        # psi_i'' = (EI_i k_i / GJ_i) (u x e(psi_i)), and u x e = u_1 sin psi - u_2 cos psi. h is in u already.
        turns = [
            here.twist[i] * (u1 * here.sin[i] - u2 * here.cos[i]) if i in here.twist else 0.0 for i in range(d)
        ]
        rates = [h * rate for rate in y[d : 2 * d]]
        bends = plus(scale_vector(u1, d1), u2, d2)
        found = [*rates, *turns, *scale_vector(-u1, t), *scale_vector(-u2, t), *bends, *cross(here.n, t)]
        return found, self._changes_of_responses(here, h, y, by) if by else []

    def _here(self, fraction: float, h: Any, y: Values) -> _Here:
        """Return the quantities at a state y that its changes are made of.

        fraction: distance from the section's end towards the tip, as a part of the section. h: length of the step,
        mm, negative.
        """
        d = len(self.tubes)
        part = self.part
        active = self.part.active
        xp = self.xp
        s = part.start + part.length * (1 - fraction)
        # Only the extensions count for curvatures: zeros stand in for the unknowns before them.
        k = curvatures_at(self.tubes, [0.0] * d + list(self.beta), part, s)
        sin = {i: xp.sin(y[i]) for i in active}
        cos = {i: xp.cos(y[i]) for i in active}
        pull = {i: h * part.shares[i] * k[i] for i in active}
        twist = {i: self.tubes[i].torsional_ratio * k[i] for i in active}
        # The innermost tube is present everywhere: its share EI_d / sum EI over EI_d is 1 / sum EI.
        flexible = h * (part.shares[-1] / self.tubes[-1].bending_stiffness)
        d1, d2, t, m = vectors(y[2 * d :])
        about = [flexible * dot(m, axis) for axis in (d1, d2, t)]
        u = about[1] + sum(pull[i] * cos[i] for i in active), sum(pull[i] * sin[i] for i in active) - about[0]
        # n at a place is all that acts beyond it: at the end of the section, and the weight between.
        n = plus(scale_vector(h, self.force), fraction, scale_vector(h * part.length, self.weight))
        if self.growth is not None:
            # growth (2 x - 1), integrated over x from 1 - fraction to 1.
            n = plus(n, fraction * (1 - fraction), scale_vector(h * part.length, self.growth))
        if self.along is not None:
            n = plus(n, h * self.along.beyond(s), self.along.force)
        return _Here(twist, sin, cos, pull, flexible, about, u, n)

    def _changes_of_responses(self, here: _Here, h: Any, y: Values, by: Values) -> Values:
        """Return the changes of responses `by` over a step h at the state y, the derivatives of those of the
        state.
        """
        d, (u1, u2), (d1, d2, t, _) = len(self.tubes), here.u, vectors(y[2 * len(self.tubes) :])
        dpsi, drates, ((a, b, c), dm, dn) = by[:d], by[d : 2 * d], vectors(by[2 * d : 2 * d + 9])
        # A softer rod bends more under the same moments: bending is multiplied here, and twisting below.
        soft = self.soft.bending
        sin = here.sin
        cos = here.cos
        soft1, soft2 = (scale_vector(soft * here.flexible, axis) for axis in (d1, d2))
        about1, about2, about3 = (soft * each for each in here.about)
        pull = {i: soft * k for i, k in here.pull.items()}
        twist = {i: self.soft.torsion * k for i, k in here.twist.items()}
        # Derivatives of u_1 and u_2 in the turned axes: by dm, by the turns (a, b, c) of the axes in which m is
        # expressed, and by dpsi.
        du1 = dot(dm, soft2) - c * about1 + a * about3 - sum(pull[i] * sin[i] * dpsi[i] for i in pull)
        du2 = sum(pull[i] * cos[i] * dpsi[i] for i in pull) - dot(dm, soft1) - c * about2 + b * about3
        # The linearised balance of torsion: psi_i'' changes with u and with the tube's own angle.
        sway = [0.0 * a] * d
        # `k` has the softness of torsion; u itself, the state's, has not.
        for i, k in twist.items():
            sway[i] = k * sin[i] * du1 - k * cos[i] * du2 + k * (u1 * cos[i] + u2 * sin[i]) * dpsi[i]
        # The frame turns at the rate omega = (-u_2, u_1, 0) along the rod, in its own axes. In these the turn (a,
        # b, c) changes by d omega - omega x (a, b, c).
        turning = -du2 - u1 * c, du1 - u2 * c, u2 * b + u1 * a
        # m' = n x t: turned by (a, b, c), t changes by b d_1 - a d_2, and n changes by dn.
        leaning = plus(scale_vector(b, cross(here.n, d1)), -1.0 * a, cross(here.n, d2))
        moments = plus(leaning, h, cross(dn, t))
        # Dead loads do not turn with the rod: a change of force at the tip (of a follower force) stays the same to
        # the base.
        forces = [0.0 * a] * 3
        moved = list[Any]()
        if self.foundation:
            # n' = -w - .., p' = t, and w changes with the place.
            displacement = (by[2 * d + 9], by[2 * d + 10], by[2 * d + 11])
            forces = [-h * dot(row, displacement) for row in self.foundation]
            moved = list(scale_vector(h, plus(scale_vector(b, d1), -1.0 * a, d2)))
        return [*(h * rate for rate in drates), *sway, *turning, *moments, *forces, *moved]
