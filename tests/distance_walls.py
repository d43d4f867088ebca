"""Walls that are distance fields of formulas: a bent tube, and a ball to keep out of."""

import numpy as np

from ctr_nlp.paths.distance_field import BLOCK_NODES, DistanceField, make_grid
from ctr_nlp.paths.walls import Body

CELL = 0.5
LOW, HIGH = np.array([-70.0, -12.0, -12.0]), np.array([12.0, 12.0, 110.0])


def nodes(cell):
    """Nodes (l, m, n, 3) of whole blocks over the box, and the transform from mm to indices."""
    count = BLOCK_NODES * np.ceil((HIGH - LOW) / cell / BLOCK_NODES).astype(int) + 5
    to_grid = np.diag([1 / cell, 1 / cell, 1 / cell, 1.0])
    to_grid[:3, 3] = -LOW / cell + 2
    at = np.stack(np.meshgrid(*map(np.arange, count), indexing="ij"), axis=-1)
    return (at - 2) * cell + LOW, to_grid


def field(distance, cell=CELL):
    """A field of a formula: fine blocks near the wall, and a coarse grid of four times the cell."""
    points, to_grid = nodes(cell)
    values = distance(points)
    size = (np.array(values.shape) - 5) // BLOCK_NODES
    inner = values[tuple(slice(2, 2 + BLOCK_NODES * n) for n in size)]
    blocks = inner.reshape(size[0], BLOCK_NODES, size[1], BLOCK_NODES, size[2], BLOCK_NODES)
    wanted = (abs(blocks) < 2.0).any(axis=(1, 3, 5))
    coarse, coarse_to_grid = nodes(4 * cell)
    return DistanceField((make_grid(values, to_grid, wanted), make_grid(distance(coarse), coarse_to_grid)))


def bent_tube(points):
    """Signed distance inside a tube of 5 mm around an arc of 100 mm radius in the x-z plane."""
    x, y, z = np.moveaxis(points, -1, 0)
    return 5.0 - np.hypot(np.hypot(x + 100.0, z) - 100.0, y)


def ball(points):
    """Signed distance inside a ball of 4 mm beside the path."""
    return 4.0 - np.linalg.norm(points - [3.0, 2.0, 50.0], axis=-1)


TUBE, BALL = Body("tube", field(bent_tube)), Body("ball", field(ball), keep_out=True, margin=0.3)
