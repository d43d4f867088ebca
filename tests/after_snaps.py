"""Where a robot comes to rest after its equilibrium has ended, by descent of the discretised energy."""

from __future__ import annotations

import numpy as np

from ctr_nlp.check.motions import CONVERGED_RATE, MAX_RATE_CHANGE
from ctr_nlp.check.shapes import GAUSS
from ctr_nlp.check.stability import Modes
from ctr_nlp.check.tubes import Tubes, Twist, integrate

DESCENT_STEP_RAD = 0.1
"""By how much a step down the energy may turn a tube, after a robot has lost its equilibrium."""
MAX_DESCENT_STEPS = 400


def settle(tubes: Tubes, rates, before, after) -> np.ndarray | None:
    """Rates (d, 1) at the base of the stable equilibrium that a robot comes to rest in once its own has ended.

    before, after: alpha and beta (d, 1) of the last equilibrium, with these rates (d, 1), and of the place beyond,
    to which the robot is moved; from there its energy falls, in steps that turn no tube by more than
    DESCENT_STEP_RAD, and Newton's method on the equations finds the rates. None where that fails.
    """
    (alpha_before, beta_before), (alpha, beta) = before, after
    old = integrate(tubes, alpha_before, beta_before, rates, sensitivities=False)
    new = integrate(tubes, alpha, beta, rates, sensitivities=False)
    energy = Energy(new, alpha)
    found = Energy(old, alpha_before).project()
    if found.shape != energy.project().shape:
        return None
    for _ in range(MAX_DESCENT_STEPS):
        value, slope, curvature = energy.at(found)
        # A Newton step in which negative curvatures count as positive ones: it goes down everywhere.
        values, vectors = np.linalg.eigh(curvature)
        step = -vectors @ ((vectors.T @ slope.ravel()) / np.maximum(abs(values), 1e-6))
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
    guess = found[:, :1] / np.sqrt((tubes.length - beta) * tubes.torsional)
    for _ in range(20):
        shot = integrate(tubes, alpha, beta, guess)
        change = -np.linalg.solve(shot.sensitivity, shot.rate[-1].T[..., None])[..., 0].T
        guess = guess + np.clip(change, -MAX_RATE_CHANGE, MAX_RATE_CHANGE)
        if abs(change).max() < CONVERGED_RATE:
            return guess
    return None


class Energy:
    """The energy of one robot at alpha (d, 1), less a constant, over coefficients (d, M) of its modes."""

    def __init__(self, twist: Twist, alpha: np.ndarray) -> None:
        self._modes = Modes(twist)
        # EI_i k_i e_i (Q, d) of tubes that do not twist
        angles = np.concatenate([twist.angles(z) for z in GAUSS])[..., 0]
        pulls = np.concatenate([twist.pulls(z) for z in GAUSS])[..., 0]
        self._untwisted = pulls * np.exp(1j * (alpha[:, 0] - angles))
        self._turned = angles - alpha[:, 0]
        self._shape = self._modes.shape[0][:, None] * self._modes.scale[0]

    def project(self) -> np.ndarray:
        """Coefficients (d, M) of the modes that come nearest to the twist that the energy was made of."""
        tubes = range(self._shape.shape[1])
        return np.array([np.linalg.lstsq(self._shape[:, i], self._turned[:, i], rcond=1e-10)[0] for i in tubes])

    def turned(self, found: np.ndarray) -> np.ndarray:
        """Angles (Q, d) of variations alone, rad."""
        return np.einsum("qim,im->qi", self._shape, found)

    def _pulls(self, found: np.ndarray) -> np.ndarray:
        return self._untwisted * np.exp(1j * self.turned(found))

    def value(self, found: np.ndarray) -> float:
        modes = self._modes
        whole = self._pulls(found).sum(axis=1)
        return float((found**2).sum() / 2 - (abs(whole) ** 2 / (2 * modes.total[0]) * modes.weight[0]).sum())

    def at(self, found: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Value, gradient (d, M) and Hessian (d M, d M)."""
        modes, pulls = self._modes, self._pulls(found)
        torque = (np.conj(pulls.sum(axis=1))[:, None] * pulls).imag * (modes.weight / modes.total).T
        slope = found + np.einsum("qim,qi->im", self._shape, torque)
        hessian = np.eye(found.size) + modes.second_variation(pulls[..., None])[0]
        return self.value(found), slope, hessian
