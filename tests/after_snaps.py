"""Where a robot comes to rest after its equilibrium has ended, by descent of the discretised energy."""

from __future__ import annotations

import numpy as np

from ctr_nlp.check.tubes import (
    CONVERGED_RATE,
    MAX_RATE_CHANGE,
    Modes,
    Piece,
    Tubes,
    integrate,
)

DESCENT_STEP_RAD = 0.1
"""By how much a step down the energy may turn a tube, after a robot has lost its equilibrium."""
MAX_DESCENT_STEPS = 400


def settle(tubes: Tubes, rates, before, after, most_turn: float) -> np.ndarray | None:
    """Rates (d, 1) at the base of the stable equilibrium that a robot comes to rest in once its own has ended.

    before, after: alpha and beta (d, 1) of the last equilibrium, with these rates (d, 1), and of the place beyond,
    to which the robot is moved; from there its energy falls, in steps that turn no tube by more than
    DESCENT_STEP_RAD, and Newton's method on the equations finds the rates. None where that fails, or where a tube
    turns by much more than most_turn rad on the way.
    """
    (alpha_before, beta_before), (alpha, beta) = before, after
    old = integrate(tubes, alpha_before, beta_before, rates, sensitivities=False)
    new = integrate(tubes, alpha, beta, rates, sensitivities=False)
    if len(new.pieces) != len(old.pieces):
        return None
    # The coefficients of the old twist: the transmission's, and projections of psi' on the modes.
    modes = Modes(old)
    speed = np.array([_rate_at(p, f) for p in old.pieces for f in modes.fractions])
    found = np.einsum("iqmn,qin,qn->imn", rates_of(modes), speed, modes.weight) * tubes.torsional[:, None]
    found[:, 0] = rates * np.sqrt((tubes.length - beta_before) * tubes.torsional)
    energy = Energy(Modes(new), alpha)
    begun = energy.angles(found)
    for _ in range(MAX_DESCENT_STEPS):
        value, slope, curvature = energy.at(found)
        # A Newton step in which negative curvatures count as positive ones: it goes down everywhere.
        values, vectors = np.linalg.eigh(curvature)
        step = -vectors @ ((vectors.T @ slope) / np.maximum(abs(values), 1e-6))
        step = step.reshape(found.shape)
        step *= min(1.0, DESCENT_STEP_RAD / max(abs(energy.turned(step)).max(), 1e-12))
        if abs(energy.turned(step)).max() < 1e-8:
            if values[0] > 0:
                break
            # At rest on a saddle, as planar robots are beyond a bifurcation: chance decides for one side.
            step = vectors[:, 0].reshape(found.shape)
            step *= DESCENT_STEP_RAD / 2 / abs(energy.turned(step)).max()
        while energy.value(found + step) > value and abs(energy.turned(step)).max() > 1e-9:
            step = step / 2
        found = found + step
        if abs(energy.angles(found) - begun).max() > 3 * most_turn + DESCENT_STEP_RAD:
            return None
    guess = found[:, 0] / np.sqrt((tubes.length - beta) * tubes.torsional)
    for _ in range(20):
        shot = integrate(tubes, alpha, beta, guess)
        change = -np.linalg.solve(np.moveaxis(shot.sensitivity, -1, 0), shot.tip_rates.T[..., None])[..., 0].T
        guess = guess + np.clip(change, -MAX_RATE_CHANGE, MAX_RATE_CHANGE)
        if abs(change).max() < CONVERGED_RATE:
            return guess
    return None


def rates_of(modes: Modes) -> np.ndarray:
    """Derivatives of the modes' angles by arc length, (d, places, count, 1)."""
    found = np.zeros_like(modes.shape)
    nodes = 2 * modes.fractions - 1
    count = len(nodes)
    degree = (modes.shape.shape[2] - 1) // len(modes.twist.pieces)
    for k, piece in enumerate(modes.twist.pieces):
        h = piece.high - piece.low
        for m in range(degree):
            scale = np.where(piece.present, np.sqrt((2 * m + 1) * h / modes.twist.tubes.torsional), 0.0)
            slope = np.polynomial.legendre.Legendre.basis(m)(nodes)
            at = slice(k * count, (k + 1) * count)
            found[:, at, 1 + k * degree + m] = scale[:, None] / np.maximum(h, 1e-12) * slope[None, :, None]
    return found


def gradient(modes: Modes, bends: np.ndarray) -> np.ndarray:
    """Derivatives (d, count, n) of the bending energy by the modes, at directions bends (places, d, n)."""
    pull = modes.strength * np.exp(1j * bends)
    whole = pull.sum(axis=1)
    torque = (np.conj(whole)[:, None] * pull).imag / modes.total[:, None]
    return np.einsum("iqmn,qin,qn->imn", modes.shape, torque, modes.weight)


class Energy:
    """The energy of one robot at alpha (d, 1), less a constant, over coefficients (d, count, 1) of its modes."""

    def __init__(self, modes: Modes, alpha: np.ndarray) -> None:
        self._modes = modes
        self._base = alpha + modes.phases

    def turned(self, found: np.ndarray) -> np.ndarray:
        """Angles (places, d, 1) of variations alone, rad."""
        return np.einsum("iqmn,imn->qin", self._modes.shape, found)

    def angles(self, found: np.ndarray) -> np.ndarray:
        """Directions (places, d, 1) in which tubes bend, rad."""
        return self._base + self.turned(found)

    def value(self, found: np.ndarray) -> float:
        modes = self._modes
        pull = (modes.strength * np.exp(1j * self.angles(found))).sum(axis=1)
        return float((found**2).sum() / 2 - (abs(pull) ** 2 / (2 * modes.total) * modes.weight).sum())

    def at(self, found: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Value, gradient (d count,) and Hessian (d count, d count)."""
        bends = self.angles(found)
        slope = (found + gradient(self._modes, bends)).ravel()
        return self.value(found), slope, np.eye(found.size) + self._modes.second_variation(bends)[0]


def _rate_at(piece: Piece, fraction: float) -> np.ndarray:
    """psi' (d, n) at a fraction of a piece, from the cubic through psi' and psi'' at the ends of its step."""
    k = min(int(fraction * piece.steps), piece.steps - 1)
    z, h = fraction * piece.steps - k, piece.h
    return (
        (1 + 2 * z) * (1 - z) ** 2 * piece.rate[k]
        + z * (1 - z) ** 2 * h * piece.turn[k]
        + z**2 * (3 - 2 * z) * piece.rate[k + 1]
        + z**2 * (z - 1) * h * piece.turn[k + 1]
    )
