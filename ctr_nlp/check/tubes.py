"""Concentric tubes on the elastic model, solved by shooting from the base.

Equations of Dupont 2010 and Rucker 2010, unloaded and frictionless. psi_i(s) is the angle of tube i,
EI_i its bending stiffness, GJ_i = EI_i / (1 + nu_i), k_i(s) its pre-curvature, which points along
e_i = (cos psi_i, sin psi_i) (of a helix: psi_i + tau_i times the distance from where its curved part begins):

    u = sum_i EI_i k_i e_i / sum_i EI_i                    over the tubes that reach s
    GJ_i psi_i'' = EI_i k_i (u x e_i)
    psi_i(0) = alpha_i + psi_i'(0) (L_i - beta_i)          the transmission twists evenly over s < 0
    psi_i'(beta_i) = 0

The unknowns are the rates psi_i'(0) (motions.py finds them). Their effect on the rates at the tips is integrated
beside the rates. In complex numbers, exp(1j psi) stands for e, and u x e is Im(conj(u) e).

Arrays carry n robots along their last axis: (d, n) for numbers of tubes, (d, d, n) for sensitivities, (N, ..) for
the N steps of integration. The body is cut at every place where a tube ends or begins to curve: within such a
piece all is smooth, and it is divided into equal steps.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[Any]

STEP_MM = 7.0
"""Longest step of integration along the body."""
NEGLIGIBLE = 1e-12
"""Stiffness of a tube beside that of the next outer one, on the dominant model."""


@dataclass(frozen=True, eq=False)
class Tubes:
    """Numbers of n robots of d tubes, (d, n) each: mm, 1/mm, rad/mm, and stiffnesses in one common unit.

    zero: the angle in rad by which a tube's base is ahead of its motor.
    """

    length: Array
    curved: Array
    root: Array
    tip: Array
    bending: Array
    torsional: Array
    helix: Array
    zero: Array
    radius: Array

    def __getitem__(self, rows: Any) -> Tubes:
        """Some of the robots."""
        return Tubes(*(getattr(self, f.name)[:, rows] for f in fields(self)))

    def repeat(self, count: int) -> Tubes:
        """The first robot so many times."""
        return self[np.zeros(count, dtype=int)]


def read_tubes(robot: dict, parts: Array | None = None) -> Tubes:
    """Tubes of a robot as a plan's meta describes it.

    Parameters
    ----------
    robot : dict
        ``meta["robot"]``: the key ``tubes`` holds a table of numbers a tube, outermost first.
    parts : (n, d, 5) array, optional
        Differences of n robots from the one described: relative curvature, relative bending stiffness, relative
        EI / GJ, curved length in mm and the motor's zero in rad. One robot as described by default.
    """
    rows = robot["tubes"]
    parts = np.zeros((1, len(rows), 5)) if parts is None else parts
    curvature, stiffness, ratio, longer, zero = np.moveaxis(parts, (2, 1), (0, 1))

    def column(name: str) -> Array:
        return np.array([float(row[name]) for row in rows])[:, None] + np.zeros_like(zero)

    ends = np.array([np.broadcast_to(row["curvature"], 2) for row in rows], dtype=float)
    outer, inner, length = column("outer_diameter"), column("inner_diameter"), column("length")
    bending = column("youngs_modulus") * np.pi / 64 * (outer**4 - inner**4) * (1 + stiffness)
    return Tubes(
        length=length,
        curved=np.clip(column("curved_length") + longer, 0.0, length),
        root=ends[:, :1] * (1 + curvature),
        tip=ends[:, 1:] * (1 + curvature),
        bending=bending,
        torsional=bending / ((1 + column("poisson_ratio")) * (1 + ratio)),
        # Older files have no helices.
        helix=column("pre_torsion") if "pre_torsion" in rows[0] else np.zeros_like(zero),
        zero=zero,
        radius=outer / 2,
    )


def make_dominant(tubes: Tubes) -> Tubes:
    """Return tubes that bend as on the dominant stiffness model: the outermost tube at a place bends by itself.

    Each tube is stiff beyond comparison with the next, and none twists.
    """
    bending = tubes.bending * NEGLIGIBLE ** np.arange(len(tubes.bending))[:, None]
    return replace(tubes, bending=bending, torsional=np.full_like(bending, np.inf))


def interpolate_cubic(z: Any, h: Array, start: Array, slope: Array, end: Array, end_slope: Array) -> Array:
    """Hermite's cubic at a fraction z of a step of length h, from values and slopes at both of its ends."""
    near = (1 + 2 * z) * (1 - z) ** 2 * start + z * (1 - z) ** 2 * h * slope
    return np.asarray(near + z**2 * (3 - 2 * z) * end + z**2 * (z - 1) * h * end_slope)


@dataclass(frozen=True, eq=False)
class Twist:
    """Tubes that are integrated from the base.

    bounds (P + 1, n): ends of the pieces of the body, mm. s (N + 1, n), h (N, n): ends and lengths of the steps,
    mm. present (N, d, n): whether tube i is there on each step. total (N, n): sum of the EI of the tubes that are
    there. psi, rate (N + 1, d, n): psi_i and psi_i' at the ends of steps. sensitivity (n, d, d): derivatives of
    psi_i'(beta_i) by psi_j'(0), (n, d, 0) where they were not asked for.
    """

    tubes: Tubes
    beta: Array
    bounds: Array
    s: Array
    h: Array
    present: Array
    total: Array
    psi: Array
    rate: Array
    sensitivity: Array

    @property
    def tip_angles(self) -> Array:
        """Angles psi_i at the tubes' own tips (d, n), rad."""
        # Beyond its tip a tube is carried on without a moment, at the rate that it has there.
        return self.psi[-1] - self.rate[-1] * (self.s[-1] - self.beta)

    def pulls(self, z: float) -> Array:
        """EI_i k_i e_i (N, d, n), as complex numbers, at a fraction z of every step."""
        untwisted = _pulls_untwisted(self.tubes, self.beta, self.s, z)
        ends = self.psi[:-1], self.rate[:-1], self.psi[1:], self.rate[1:]
        return untwisted * np.exp(1j * interpolate_cubic(z, self.h[:, None], *ends))

    def bending(self, z: float) -> Array:
        """The bending vectors u (N, n), 1/mm, as complex numbers, at a fraction z of every step."""
        return self.pulls(z).sum(axis=1) / self.total


def _pulls_untwisted(tubes: Tubes, beta: Array, s: Array, z: float) -> Array:
    """EI_i k_i e_i (N, d, n) of tubes whose psi is 0, at a fraction z of every step between s (N + 1, n)."""
    middle, from_tip = (beta - (s[:-1] + part * np.diff(s, axis=0))[:, None] for part in (0.5, z))
    bends = (middle > 0) & (middle < tubes.curved)
    growth = (tubes.root - tubes.tip) / np.maximum(tubes.curved, 1e-9)
    strength = np.where(bends, tubes.bending * (tubes.tip + growth * from_tip), 0.0)
    return strength * np.exp(1j * tubes.helix * (tubes.curved - from_tip))


def integrate(tubes: Tubes, alpha: Array, beta: Array, rates: Array, sensitivities: bool = True) -> Twist:
    """Integrate psi from the base, where its derivatives are `rates`; all (d, n).

    Nystrom's method of order 4 (three evaluations a step), since psi' does not appear on the right-hand side.
    """
    begin = np.maximum(beta - tubes.curved, 0.0)
    bounds = np.sort(np.concatenate([np.zeros_like(beta[:1]), beta, begin]), axis=0)
    bounds = bounds[np.diff(bounds, axis=0, prepend=-1.0).max(axis=1) > 0]
    counts = np.ceil(np.diff(bounds, axis=0).max(axis=1) / STEP_MM).astype(int)
    piece = np.repeat(np.arange(len(counts)), counts)
    part = np.concatenate([np.arange(count) / count for count in counts])
    s = np.concatenate([bounds[piece] + part[:, None] * np.diff(bounds, axis=0)[piece], bounds[-1:]])
    steps = np.diff(s, axis=0)
    present = (s[:-1] + steps / 2)[:, None] < beta
    total = np.where(present, tubes.bending, 0.0).sum(axis=1)
    total = np.where(total > 0, total, 1.0)
    untwisted = [_pulls_untwisted(tubes, beta, s, z) for z in (0.0, 0.5, 1.0)]

    def second_derivative(y: Array, k: int, half: int) -> Array:
        """Return y'' at the start, middle or end (half = 0, 1, 2) of step k."""
        pull = untwisted[half][k] * np.exp(1j * y[0])
        change = 1j * pull * y[1:]
        u, du = pull.sum(axis=0) / total[k], change.sum(axis=1) / total[k]
        turn = np.conj(u) * pull
        return (
            np.concatenate([turn[None], np.conj(du)[:, None] * pull + np.conj(u) * change]).imag / tubes.torsional
        )

    # y[0] is psi, and y[j] its derivative by the j-th rate at the base.
    own = np.eye(len(beta))[: len(beta) if sensitivities else 0, :, None] + np.zeros_like(beta)
    rate = np.concatenate([rates[None], own])
    y = rate * (tubes.length - beta)
    y[0] += alpha
    nodes = [(y[0], rate[0])]
    for k, h in enumerate(steps):
        first = second_derivative(y, k, 0)
        second = second_derivative(y + h / 2 * rate + h**2 / 8 * first, k, 1)
        third = second_derivative(y + h * rate + h**2 / 2 * second, k, 2)
        y = y + h * rate + h**2 / 6 * (first + 2 * second)
        rate = rate + h / 6 * (first + 4 * second + third)
        nodes.append((y[0], rate[0]))
    psi, turned = (np.array(each) for each in zip(*nodes, strict=True))
    sensitivity = np.moveaxis(rate[1:], (0, 1, 2), (2, 1, 0))
    return Twist(tubes, beta, bounds, s, steps, present, total, psi, turned, sensitivity)
