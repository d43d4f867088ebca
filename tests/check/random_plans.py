"""Random plans for tests of the checker: robots, motions, walls, loads, samples and deployed starts of all kinds.

Made with the public interface of the package alone: nothing here knows the checker.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ctr_nlp import Limits, Load, Plan, Problem, Robot, Tolerances, Tube, curve_from_points, growing, plan_through
from ctr_nlp.anatomy.distance_fields import field_of_surface, flatten_steps, surface_of_mask
from ctr_nlp.paths.distance_field import BLOCK_NODES, DistanceField, make_grid
from ctr_nlp.paths.surface import Surface
from ctr_nlp.paths.walls import Body
from ctr_nlp.plan.simulation import simulate_motion

Distance = Callable[[np.ndarray], np.ndarray]
"""Signed distance (..,), mm, positive inside a body, of points (.., 3)."""
FRAMES = 10
DURATION_S = 10.0
DIAMETERS = (6.0, 5.0), (4.4, 3.6), (3.0, 2.2), (1.6, 1.0)
"""Outer and inner, mm: every tube more than three times as stiff as the next, as the dominant model needs."""
WALLS = "none", "lumen", "body", "keep-out", "lumen and keep-out"
SOURCES = "distance", "mesh", "mask"
"""What the surfaces of bodies are made from."""
VOXEL_MM = 1.5
MAX_CURVATURE = 0.012
"""Of most robots, 1/mm."""
STRONG_CURVATURE = 0.03
SIMILAR_DIAMETERS = (3.0, 2.6), (2.4, 2.0), (1.8, 1.2), (1.0, 0.4)
"""Of strongly curved robots on the elastic model, whose tubes are nearly as stiff as each other."""
NEAR_FOLD = 0.02, 0.15
"""Least stability margins of the motions that lead near a fold."""
MODELS = "elastic", "dominant"
SAMPLES = 40
CELL_MM = 3.0


def random_plan(seed: int, samples: bool = False) -> Plan:
    """A plan that differs with the seed in robot, motion, model, wall, load, and in where the robot begins."""
    random = np.random.default_rng(seed)
    model = MODELS[seed % 2]
    near_fold = model == "elastic" and seed % 7 == 2
    similar = near_fold or (model == "elastic" and seed % 7 == 5)
    robot = _robot(random, *((SIMILAR_DIAMETERS, STRONG_CURVATURE) if similar else (DIAMETERS, MAX_CURVATURE)))
    while near_fold and sum(np.any(tube.curvature) for tube in robot.tubes) < 2:
        robot = _robot(random, SIMILAR_DIAMETERS, STRONG_CURVATURE)
    q = _motion(random, robot)
    if near_fold:
        q = _turn_towards_fold(random, robot, q)
    path = _path(random, robot, q, model)
    kind = WALLS[seed % len(WALLS)]
    radius = random.uniform(4.0, 9.0) + random.uniform(0, 1.0) * np.cos(np.linspace(0, 6, len(path)))
    in_lumen = kind.startswith("lumen")
    curve = curve_from_points(path, radius if in_lumen else None)
    source = SOURCES[seed // 10 % len(SOURCES)]
    walls = {
        "body": lambda: (_lumen_body(path, radius, source),),
        "keep-out": lambda: (_ball(random, path, source),),
        "lumen and keep-out": lambda: (_ball(random, path, source),),
    }.get(kind, tuple)()
    target = growing(curve, FRAMES)
    problem = Problem("random", robot, target, duration=DURATION_S, lumen=curve if in_lumen else None, walls=walls)
    plan = plan_through(problem, q, model=model)
    solved = {name: np.zeros(FRAMES) for name in ("kkt", "objective", "solve_time")}
    plan = replace(plan, **solved)
    if samples and not (seed % 2 or plan.meta["snaps"]):
        plan = plan.with_samples(SAMPLES, seed)
    if seed % 10 == 3:
        plan = plan.with_modulus(60_000).with_load(Load(force=(0.01, 0.0, 0.0)))
    elif seed % 10 == 8:
        plan = plan.reversed() if seed % 20 == 8 else plan[FRAMES // 3 :]
    return plan


def _robot(random: np.random.Generator, diameters: tuple[tuple[float, float], ...], curvature: float) -> Robot:
    """A robot of one to four of the tubes, none curved by more than `curvature`, 1/mm."""
    d = int(random.integers(1, 5))
    curved = np.sort(random.uniform(25, 130, d))
    lengths = curved + np.sort(random.uniform(20, 120, d))
    tubes = []
    for i, (outer, inner) in enumerate(diameters[-d:]):
        ends = random.uniform(0.0, curvature, 2)
        bend = [0.0, float(ends[0]), tuple(ends.tolist())][int(random.integers(3)) if i else 1]
        tubes.append(
            Tube(float(lengths[i]), float(curved[i]), bend, outer, inner, float(random.uniform(0.2, 0.4)))
        )
    tolerances = Tolerances(
        curvature=0.02, bending_stiffness=0.02, motor_zero=0.02, rotation_lag=float(random.choice([0.0, 0.03]))
    )
    limits = Limits(alpha_acceleration=50.0) if random.random() < 0.3 else Limits()
    return Robot(tuple(tubes), limits, tolerances)


def _motion(random: np.random.Generator, robot: Robot) -> np.ndarray:
    """Tubes that come out while they turn, within limits."""
    d = robot.d
    reach = np.array([tube.curved_length for tube in robot.tubes])
    t = np.linspace(0, 1, FRAMES)[:, None]
    beta = reach * (0.3 + 0.65 * t ** random.uniform(0.7, 1.3))
    turn = random.uniform(-1.2, 1.2, d)
    alpha = random.uniform(-3, 3) + random.uniform(-0.8, 0.8, d) + turn * t
    theta = random.uniform(-0.15, 0.15, 2) * t
    return np.hstack([alpha, beta, theta])


def _turn_towards_fold(random: np.random.Generator, robot: Robot, q: np.ndarray) -> np.ndarray:
    """A motion on which the innermost tube turns on until the least margin is within NEAR_FOLD, if ever."""
    turn = np.zeros_like(q)
    turn[:, robot.d - 1] = np.linspace(0, random.choice([-1, 1]) * 1.5 * np.pi, FRAMES)

    def least_margin(part: float) -> float:
        found = simulate_motion(robot, q + part * turn, "elastic")
        return 0.0 if found.snaps else float(np.nan_to_num(found.stability_between).min())

    low, high = 0.0, 1.0
    for _ in range(12):
        middle = (low + high) / 2
        margin = least_margin(middle)
        if NEAR_FOLD[0] <= margin <= NEAR_FOLD[1]:
            return q + middle * turn
        low, high = (middle, high) if margin > NEAR_FOLD[1] else (low, middle)
    return q + low * turn


def _path(random: np.random.Generator, robot: Robot, q: np.ndarray, model: str) -> np.ndarray:
    """Points of a path near the robot's last shape; of another shape in half of all cases."""
    shape = simulate_motion(robot, q, model).shape[-1][::5]
    if not np.isfinite(shape).all():
        shape = np.linspace(0, 1, 21)[:, None] * np.array([0, 0, q[-1, 2 * robot.d - 1]])
    if random.random() < 0.5:
        shape = shape + np.linspace(0, 1, len(shape))[:, None] ** 2 * random.uniform(-4, 4, 3) * [1, 1, 0]
    return shape


def _lumen_body(path: np.ndarray, radius: np.ndarray, source: str) -> Body:
    """The inside of a lumen around a path."""
    fine = np.linspace(0, len(path) - 1, 400)
    points = np.stack([np.interp(fine, np.arange(len(path)), path[:, k]) for k in range(3)], axis=1)
    along = np.interp(fine, np.arange(len(path)), radius)
    tree = cKDTree(points)

    def distance(places: np.ndarray) -> np.ndarray:
        away, nearest = tree.query(places)
        return along[nearest] - away

    return _body("lumen", distance, path, source)


def _ball(random: np.random.Generator, path: np.ndarray, source: str) -> Body:
    """A ball beside the path, to keep out of."""
    radius = random.uniform(3, 6)
    centre = path[int(random.integers(8, len(path)))] + random.choice([-1, 1]) * (radius + random.uniform(3, 6))
    margin = float(random.choice([0.0, 0.3]))

    def distance(places: np.ndarray) -> np.ndarray:
        return radius - np.linalg.norm(places - centre, axis=-1)

    return replace(_body("ball", distance, path, source), keep_out=True, margin=margin)


def _body(name: str, distance: Distance, path: np.ndarray, source: str) -> Body:
    """A body from its signed distance: sampled, or by a mesh or mask, whose triangles the file has as well."""
    if source == "distance":
        return Body(name, _sampled(distance, path))
    pyvista = pytest.importorskip("pyvista", reason="surfaces of meshes and masks need pyvista")
    low = path.min(axis=0) - 12
    count = np.ceil((path.max(axis=0) + 12 - low) / VOXEL_MM).astype(int)
    values = distance(np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1) * VOXEL_MM + low)
    affine = np.diag([VOXEL_MM] * 3 + [1.0])
    affine[:3, 3] = low
    if source == "mask":
        surface = flatten_steps(surface_of_mask(values > 0, affine))
        return Body(name, field_of_surface(surface, cells=affine), surface=surface)
    image = pyvista.ImageData(dimensions=values.shape, spacing=(VOXEL_MM,) * 3, origin=low)
    image.point_data["distance"] = values.ravel(order="F")
    mesh = image.contour([0.0], scalars="distance", method="flying_edges", compute_normals=False)
    surface = Surface(mesh.points, mesh.faces.reshape(-1, 4)[:, 1:])
    return Body(name, field_of_surface(surface), surface=surface)


def _sampled(distance: Distance, path: np.ndarray) -> DistanceField:
    low = path.min(axis=0) - 12
    blocks = np.ceil((path.max(axis=0) + 12 - low) / CELL_MM / BLOCK_NODES).astype(int)
    count = BLOCK_NODES * blocks + 5
    to_grid = np.diag([1 / CELL_MM] * 3 + [1.0])
    to_grid[:3, 3] = 2 - low / CELL_MM
    nodes = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1)
    return DistanceField((make_grid(distance((nodes - 2) * CELL_MM + low), to_grid),))
