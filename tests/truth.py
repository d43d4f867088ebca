"""What the elastic model is tested against: shared reference shapes, and its equations solved by other means."""

from __future__ import annotations

import functools
import itertools
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy.linalg
from frames import follow, untwisted
from scipy.integrate import OdeSolution, solve_ivp
from scipy.optimize import fsolve
from scipy.spatial.transform import Rotation

from ctr_nlp import Limits, Robot, Tube, table_i_robot

CASES = 28
TWO = Robot(
    (Tube(90, 45, (0.01, 0.025), 4.0, 3.2), Tube(110, 80, 0.02, 2.6, 1.6)), Limits(beta=[(0, 60), (0, 110)])
)
FOUR = Robot(
    (
        Tube(70, 50, (0.012, 0.004), 6.0, 5.2),
        Tube(130, 70, 0.01, 4.6, 3.8, poisson_ratio=0.4),
        Tube(220, 90, (0.0, 0.018), 3.2, 2.4, youngs_modulus=1.2),
        Tube(300, 100, 0.015, 2.0, 1.2),
    ),
    Limits(beta=[(0, 70), (0, 130), (0, 150), (0, 200)]),
)
CONFIGURATIONS = {
    "two tubes, one pushed out beyond its curved part": (TWO, (2.2, -0.3, 55, 100, 0.3, -0.2)),
    "two tubes, both within their curved parts": (TWO, (3.2, 0.4, 25, 50, 0.0, 0.4)),
    "two tubes that are hardly out": (TWO, (-4.0, 0.5, 1, 3, 0.0, 0.0)),
    "four tubes": (FOUR, (2.5, -1.0, 0.4, 2.0, 60, 80, 110, 130, -0.4, 0.2)),
    "four tubes, two of which end together": (FOUR, (0.5, -1.5, 1.6, 0.4, 40, 65, 65, 190, 0, 0)),
}


class Case(NamedTuple):
    """A reference shape, points (31, 3) mm at uniform sigma, and our equilibrium x at its q."""

    robot: Robot
    q: np.ndarray
    x: np.ndarray
    points: np.ndarray
    margin: float
    determinant: float


@functools.cache
def case(folder: Path, number: int) -> Case:
    """One of the shapes of elastic_reference.json; of "opposed" ones the untwisted equilibrium, stable or not."""
    data = json.loads((folder / "elastic_reference.json").read_text())["configurations"]
    assert len(data) == CASES
    data = data[number]
    robot = table_i_robot(literal=data["robot"] == "seed_table_literal")
    q = np.concatenate([data["alpha_rad"], data["beta_mm"], data["theta_rad"]])
    start = untwisted(robot, q) if "opposed" in data.get("kind", "") else None
    (x,) = follow(robot, q[None], start).x
    return Case(robot, q, x, np.array(data["points_mm"]), data["stability_margin"], data["stability_det"])


@functools.cache
def shot(name: str) -> Shot:
    """One of the configurations, solved by shooting."""
    robot, q = CONFIGURATIONS[name]
    return Shot(robot, np.array(q, dtype=float))


@dataclass(frozen=True)
class Shot:
    """The model's equations integrated from the base, with rates there such that the tips are untwisted.

    rates (d,): these, where known; else they are found on the branch that all tubes are turned to from alpha_d.
    """

    robot: Robot
    q: np.ndarray
    rates: tuple[float, ...] | None = None

    @property
    def torsion(self) -> np.ndarray:
        """GJ of the tubes, (d,)."""
        return np.array([tube.bending_stiffness / (1 + tube.poisson_ratio) for tube in self.robot.tubes])

    @cached_property
    def x(self) -> np.ndarray:
        """The same equilibrium in our unknowns: the angles at the tips, and beta and theta."""
        d = self.robot.d
        *others, inner = (self._bends(self.q[d + i])[i] for i in range(d))
        return np.concatenate([np.array(others) - inner, [inner], self.q[d:]])

    @cached_property
    def solution(self) -> tuple[list[float], list[OdeSolution]]:
        """Where tubes end or begin to curve, and between them psi, psi', the point, d1, d2 and t."""
        if self.rates is not None:
            return self._shoot(self.q, np.array(self.rates), 1e-11)[:2]
        rates, aligned = np.zeros(self.robot.d), self.q.copy()
        aligned[: self.robot.d] = self.q[self.robot.d - 1]
        for q in np.linspace(aligned, self.q, 11)[1:]:
            rates = fsolve(lambda r, q=q: 100 * self._shoot(q, r / 100, 1e-7)[2], 100 * rates, epsfcn=1e-6) / 100
        for _ in range(2):
            rates -= np.linalg.solve(self._slopes(rates), self._shoot(self.q, rates, 1e-11)[2])
        places, parts, twists = self._shoot(self.q, rates, 1e-11)
        np.testing.assert_allclose(twists, 0, atol=1e-11)
        return places, parts

    def _slopes(self, rates: np.ndarray) -> np.ndarray:
        """Of the tips' rates over those at the base, by central differences."""
        steps = 1e-6 * np.eye(self.robot.d)
        ends = [[self._shoot(self.q, r, 1e-11)[2] for r in (rates + step, rates - step)] for step in steps]
        return np.array([(after - before) / 2e-6 for after, before in ends]).T

    def at(self, s: float) -> np.ndarray:
        """The state at s mm."""
        places, parts = self.solution
        k = min(max(int(np.searchsorted(places, s)) - 1, 0), len(parts) - 1)
        return parts[k](s)

    def points(self, sigma: np.ndarray) -> np.ndarray:
        """Of the shape, (n, 3) mm."""
        d = self.robot.d
        return np.array([self.at(s)[2 * d : 2 * d + 3] for s in sigma * self.q[2 * d - 1]])

    def margin(self, elements: int = 60) -> float:
        """By linear finite elements, so many between neighbouring places; a transmission is one."""
        d, (places, _) = self.robot.d, self.solution
        beta = self.q[d : 2 * d]
        grid = np.unique(np.concatenate([np.linspace(*pair, elements + 1) for pair in itertools.pairwise(places)]))
        middles, n = (grid[1:] + grid[:-1]) / 2, len(grid)
        stiff, bent = np.eye(d * n) * 1e-12, np.zeros((d * n, d * n))
        for i, tube in enumerate(self.robot.tubes):
            torsion = self.torsion[i]
            stiff[i * n, i * n] += torsion / (tube.length - beta[i])
            for k in np.flatnonzero(middles < beta[i]):
                nodes = np.ix_([i * n + k, i * n + k + 1], [i * n + k, i * n + k + 1])
                stiff[nodes] += torsion / (grid[k + 1] - grid[k]) * np.array([[1, -1], [-1, 1]])
        for k, s in enumerate(middles):
            psi, h = self._bends(s), grid[k + 1] - grid[k]
            pull, total = self._pulls(s, beta)
            for i, j in itertools.product(range(d), range(d)):
                value = pull[i] * pull[j] / total * np.cos(psi[i] - psi[j]) * h / 4
                for a, b in itertools.product((0, 1), (0, 1)):
                    bent[i * n + k + a, j * n + k + b] -= value
                    bent[i * n + k + a, i * n + k + b] += value
        return 1 + float(scipy.linalg.eigh(bent, stiff, eigvals_only=True, subset_by_index=[0, 0])[0])

    def _bends(self, s: float) -> np.ndarray:
        """Where tubes bend to at s, (d,)."""
        return self.at(s)[: self.robot.d] + self._made(s)

    def _made(self, s: float) -> np.ndarray:
        """What helices turn by of themselves from where their curved parts begin, (d,)."""
        begins = self.q[self.robot.d : 2 * self.robot.d] - [tube.curved_length for tube in self.robot.tubes]
        return np.array([tube.pre_torsion for tube in self.robot.tubes]) * (s - begins)

    def _pulls(self, s: float, beta: np.ndarray) -> tuple[np.ndarray, float]:
        """EI_i k_i of the tubes at s, and the sum of all EI there."""
        pulls, total = np.zeros(self.robot.d), 0.0
        for i, tube in enumerate(self.robot.tubes):
            if s < beta[i]:
                total += tube.bending_stiffness
                from_tip = (beta[i] - s) / tube.curved_length
                if from_tip < 1:
                    k = tube.tip_curvature + (tube.root_curvature - tube.tip_curvature) * from_tip
                    pulls[i] = tube.bending_stiffness * k
        return pulls, total

    def _shoot(self, q, rates, tolerance):
        d, tubes = self.robot.d, self.robot.tubes
        beta, torsion = q[d : 2 * d], self.torsion
        starts = [max(b - tube.curved_length, 0.0) for b, tube in zip(beta, tubes, strict=True)]
        places = sorted({0.0, *map(float, beta), *map(float, starts)})
        psi = q[:d] + rates * np.array([tube.length - b for b, tube in zip(beta, tubes, strict=True)])
        axes = (Rotation.from_rotvec([0, q[-1], 0]) * Rotation.from_rotvec([q[-2], 0, 0])).as_matrix()
        state, parts, twists = np.concatenate([psi, rates, np.zeros(3), *axes.T]), [], np.array(rates)
        for start, end in itertools.pairwise(places):
            middle = (start + end) / 2

            def slope(s, y, middle=middle):
                inside = np.nextafter(s, middle)
                pulls, total = self._pulls(inside, beta)
                psi, (d1, d2, t) = y[:d] + self._made(s), y[2 * d + 3 :].reshape(3, 3)
                u = np.array([pulls @ np.cos(psi), pulls @ np.sin(psi)]) / total
                moments = pulls * (u[0] * np.sin(psi) - u[1] * np.cos(psi))
                bends = -u[0] * t, -u[1] * t, u[0] * d1 + u[1] * d2
                return np.concatenate([y[d : 2 * d], moments / torsion, t, *bends])

            options = {"method": "DOP853", "rtol": tolerance, "atol": 1e-12, "dense_output": True}
            run = solve_ivp(slope, (start, end), state, **options)
            state = run.y[:, -1]
            parts.append(run.sol)
            twists = np.where(beta >= end, state[d : 2 * d], twists)
        return places, parts, twists
