"""Curvature of the robot against the target's, eq. (11), smoothed and exact, for the first of the two stages.

The paper's eq. (11) is an integral over the robot's arc length, sum_i int (k_i - kbar(s L / beta_d))^2 ds with
curvatures in 1/mm. Here it is a mean over sigma = s / beta_d, since the integral shrinks with the robot, and is
scaled to mm^2 (curvature_to_shape_scale), so that its weights compare with those of shape errors. Symbols: turning
is the integral of the target's curvature over its arc length (rad), kappa that curvature, both at uniform sigma.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi as ca
import numpy as np

from ctr_nlp.models.dominant import shape
from ctr_nlp.ocp.nlp import CostTerm, Residual
from ctr_nlp.robot.structure import Tubes


def length_residual(beta_d: ca.SX, target_length: ca.SX, weight: float) -> Residual:
    """Return the residual of the deployed length beta_d against target_length, mm; weight has no unit."""
    return Residual("length", np.sqrt(weight) * (beta_d - target_length))


def curvature_to_shape_scale(reach: Any) -> Any:
    """Return the factor reach^2 / (2 sqrt 5), mm^2, that converts curvature errors in 1/mm to shape errors in mm.

    A constant curvature error along the whole reach, mm, moves the points by it times s^2 / 2; this is the root
    mean square over sigma.
    """
    # sqrt(mean of (s^2 / 2)^2) with s = sigma reach: the mean of sigma^4 over [0, 1] is 1/5.
    return reach**2 / (2 * np.sqrt(5))


def curvature(
    tubes: Tubes, beta: Sequence[ca.SX], reach: ca.SX, turning: ca.SX, target_length: ca.SX, width: ca.SX
) -> CostTerm:
    """Return the cost of the robot's curvature against the target's, eq. (11), with smoothed jumps.

    tubes, beta: of the robot, extensions in mm. reach: mm, see curvature_to_shape_scale. turning: (n + 1,)
    integral of the target's curvature in rad at uniform sigma; target_length: mm. width: of the smoothed jumps,
    mm. The target's mean over each cell is compared with the robot's value at its middle. As a mean over sigma,
    the sum cannot be made small by shrinking the robot. A CostTerm, not a Residual: the curvature error left at
    the optimum is large and its second derivatives dominate, so that Gauss-Newton steps do not converge.
    """
    cells = turning.numel() - 1
    middle = ca.DM((np.arange(cells) + 0.5) / cells)
    # Mean curvature of a cell: the angle turned in it over its length, target_length / cells.
    mean = (turning[1:] - turning[:-1]) * (cells / target_length)
    here = shape.curvature(tubes, beta, middle * beta[-1], lambda x: smooth_step(x / width), ca)
    return CostTerm("curvature", curvature_to_shape_scale(reach) ** 2 / cells * ca.sumsqr(here - mean))


def smooth_step(x: Any) -> Any:
    """Return a smooth step S(x) from 0 to 1; 96 % of the rise lies in [-1, 1]."""
    return (1 + ca.tanh(2 * x)) / 2


def curvature_exact(
    tubes: Tubes, beta: Sequence[ca.SX], reach: ca.SX, kappa: ca.SX, turning: ca.SX, target_length: ca.SX
) -> CostTerm:
    """Return the cost of eq. (11) as an exact mean over sigma, without any smoothing of jumps.

    tubes, beta: of the robot, extensions in mm. reach: mm. kappa: (n + 1,) in 1/mm and turning: (n + 1,) in rad,
    at uniform sigma; target_length: mm. For each tube, the mean of (k - kappa)^2 needs the target's curvature only
    through its cumulative integrals at the tube's two ends. The mean of kappa^2, which no beta changes, is left
    out.
    """
    total = ca.SX(0)
    start = ca.SX(0)
    first, second = _cumulative(kappa, turning, target_length)
    for i, tube in enumerate(tubes):
        low, at_low, slope = shape.curved_part(tubes, i, start, beta[i], ca)
        # From s to sigma: dk/dsigma = beta_d dk/ds.
        sigma_low = low / beta[-1]
        sigma_high = beta[i] / beta[-1]
        per_sigma = slope * beta[-1]
        width = sigma_high - sigma_low
        turned = first(sigma_high) - first(sigma_low)
        # int k^2 dsigma with k = at_low + per_sigma (sigma - sigma_low).
        own = at_low**2 * width + at_low * per_sigma * width**2 + per_sigma**2 * width**3 / 3
        # int k kappa dsigma; for a linear k by parts, with F the integral of kappa and S that of F:
        # per_sigma (width F(high) - S(high) + S(low)).
        mixed = at_low * turned
        if tube.kind == "linear":
            mixed += per_sigma * (width * first(sigma_high) - second(sigma_high) + second(sigma_low))
        # A tube's straight part, before sigma_low, has k = 0 and adds nothing.
        total += own - 2 * mixed
        start = beta[i]
    return CostTerm("curvature", curvature_to_shape_scale(reach) ** 2 * total)


def _cumulative(kappa: ca.SX, turning: ca.SX, target_length: ca.SX) -> tuple[Any, Any]:
    """Return the integral F over sigma of the target's curvature, and F's own integral S, as functions of sigma.

    Between grid points F is the cubic that matches turning and kappa at both: C1 everywhere. Units: 1/mm.
    """
    cells = kappa.numel() - 1
    h = 1 / cells
    nodes = ca.DM(np.arange(cells) * h)
    # d(turning) = kappa ds = kappa L dsigma.
    rise = (turning[1:] - turning[:-1]) / target_length
    a = kappa[:-1]
    b = kappa[1:]
    # Hermite's cubic in c = sigma - node: F = F_node + a c + square c^2 + cubic c^3.
    cubic = (a + b) / h**2 - 2 * rise / h**3
    square = 3 * rise / h**2 - (2 * a + b) / h
    before = turning[:-1] / target_length

    def first(sigma: ca.SX) -> ca.SX:
        """F: the sum of all cells' increments, each up to sigma."""
        # Clamping gives whole cells before sigma, a part of its own, and none after: no case and no table
        # look-up.
        c = ca.fmin(ca.fmax(sigma - nodes, 0), h)
        return ca.sum1(c * (a + c * (square + c * cubic)))

    def second(sigma: ca.SX) -> ca.SX:
        """S: the integral of F, cell by cell, each up to sigma."""
        c = ca.fmin(ca.fmax(sigma - nodes, 0), h)
        return ca.sum1(c * (before + c * (a / 2 + c * (square / 3 + c * cubic / 4))))

    return first, second
