"""Synthetic trees of airways with uneven sections, as branches and as masks, from a seed.

A tree grows from the trachea: the widest end divides in two until there are as many ends as asked for, so that
wide bronchi are not left undivided beside narrow ones. Diameters fall from one generation to the next as measured
ones do (Weibel, Morphometry of the Human Lung, 1963: by 0.79 on average), the two sides unlike each other.
Sections of the mask are not round: the radius varies with a random field over the wall.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ctr_nlp.anatomy.branch import Branch, Branches, LumenMask
from ctr_nlp.anatomy.formats.images import IMAGE_SPACE_TO_LPS
from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.support.value_checks import number, whole_number
from ctr_nlp.typing import Array

TRACHEA_MM = (18.0, 60.0)
"""Diameter of the trachea, and length of its lower part, with which trees begin, mm."""
MAIN_BRONCHI_MM = ((15.0, 15.0), (22.0, 25.0)), ((12.0, 13.0), (40.0, 50.0))
"""Least and largest diameter and length of the right and of the left main bronchus, mm."""
DIAMETER_RATIOS = (0.66, 0.86)
"""Diameter of a bronchus over that of its parent."""
LENGTH_OVER_DIAMETER = (1.5, 3.0)
"""Length of a bronchus over its diameter."""
ANGLES_DEG = ((12.0, 30.0), (30.0, 58.0))
"""Angles between a bronchus and its two children: of the one that leads on, and of the one that leaves."""
ROLL_DEG = (50.0, 90.0)
"""Angle between the planes of consecutive bifurcations."""
MAX_SYNTHETIC_ENDS = 200
TREE_SPACING_MM = 0.5
"""Distance between the points of a branch, mm."""
GROWTH_TRIES = 200
"""Directions that are tried for a bifurcation, of which that with the most room around it is taken."""
MIN_ROOM_MM = 2.0
"""Tissue between bronchi that are not connected, mm, with which a direction is good enough."""
CORRELATION_MM = 2.5
"""Standard deviation of the filter that makes the random field of the wall, mm."""
UNEVENNESS = 0.22
"""Standard deviation of the wall's distance from the centreline, as a part of the local radius."""
MAX_DEVIATIONS = 1.5
"""Largest deviation of the radius, in standard deviations: more would close narrow bronchi."""


@dataclass
class _Piece:
    """A bronchus: points (n, 3) mm, radii (n,) mm, the piece before it, and the plane in which it was left."""

    points: Array
    radius: Array
    before: int
    normal: Array

    @property
    def direction(self) -> Array:
        """Unit tangent at the end."""
        step = self.points[-1] - self.points[-2]
        return np.asarray(step / np.linalg.norm(step))


def synthetic_tree(seed: int = 0, ends: int = 20) -> Branches:
    """Grow a random tree of airways.

    Parameters
    ----------
    seed : int
        Seed of numpy's default generator.
    ends : int
        Number of ends, from 2.

    Returns
    -------
    Branches
        A path from the trachea to each end, mm in LPS, with the lumen's mean radius; branches share the points up
        to where they part.

    Raises
    ------
    OptionError
        `seed` or `ends` is out of its range.

    Examples
    --------
    >>> tree = synthetic_tree(seed=1, ends=6)
    >>> len(tree.branches), tree.branches[0].points[0].tolist()
    (6, [0.0, 0.0, 0.0])
    """
    whole_number(OptionError, "seed", seed, 0)
    if not 2 <= whole_number(OptionError, "ends", ends, 2) <= MAX_SYNTHETIC_ENDS:
        raise OptionError(f"ends is {ends}; it must be from 2 to {MAX_SYNTHETIC_ENDS}")
    random = np.random.default_rng(seed)
    diameter, length = TRACHEA_MM
    # Adding 0 makes a negative zero a positive one.
    down = np.arange(0.0, length + TREE_SPACING_MM / 2, TREE_SPACING_MM)[:, None] * [0.0, 0.0, -1.0] + 0.0
    # The carina parts to the sides: its plane is that of x and z, whose normal is y.
    pieces = [_Piece(down, np.full(len(down), diameter / 2), -1, np.array([1.0, 0.0, 0.0]))]
    # The widest end first; its number settles ties.
    open_ends = [(-diameter, 0)]
    while len(open_ends) < ends:
        _, last_end = heapq.heappop(open_ends)
        for child in _divide(pieces, last_end, random):
            pieces.append(child)
            heapq.heappush(open_ends, (-2 * float(child.radius[-1]), len(pieces) - 1))
    branches = list[Branch]()
    for tip in sorted(place for _, place in open_ends):
        way = [tip]
        while pieces[way[-1]].before >= 0:
            way.append(pieces[way[-1]].before)
        parts = [pieces[k] for k in way[::-1]]
        # A piece begins with the last point of the one before it.
        points = np.vstack([parts[0].points, *(part.points[1:] for part in parts[1:])])
        radius = np.concatenate([parts[0].radius, *(part.radius[1:] for part in parts[1:])])
        branches.append(Branch(f"branch {len(branches) + 1}", points, radius))
    return Branches(tuple(branches), "LPS", np.eye(4))


def _divide(pieces: list[_Piece], parent: int, random: np.random.Generator) -> tuple[_Piece, _Piece]:
    """Return the two bronchi into which a piece divides, in the first direction with room, or that with most."""
    before = pieces[parent]
    diameter = 2 * float(before.radius[-1])
    if parent == 0:
        sizes = [(random.uniform(*wide), random.uniform(*long)) for wide, long in MAIN_BRONCHI_MM]
    else:
        ratios = np.sort(random.uniform(*DIAMETER_RATIOS, 2))[::-1]
        sizes = [(diameter * ratio, diameter * ratio * random.uniform(*LENGTH_OVER_DIAMETER)) for ratio in ratios]
    others = [piece for k, piece in enumerate(pieces) if k != parent]
    best: tuple[float, tuple[_Piece, _Piece]] | None = None
    for _ in range(GROWTH_TRIES):
        roll = 0.0 if parent == 0 else random.choice([-1, 1]) * np.radians(random.uniform(*ROLL_DEG))
        side = Rotation.from_rotvec(roll * before.direction).apply(before.normal)
        angles = np.radians([random.uniform(*each) for each in ANGLES_DEG])
        if parent == 0:
            angles = np.radians(random.uniform(28.0, 45.0, 2))
        signs = random.permutation([-1, 1])
        first, second = (
            _grow(before, parent, size, sign * angle, side)
            for size, angle, sign in zip(sizes, angles, signs, strict=True)
        )
        room = min((_room_between(child, others) for child in (first, second)), default=math.inf)
        if best is None or room > best[0]:
            best = room, (first, second)
        if room >= MIN_ROOM_MM:
            break
    assert best is not None
    return best[1]


def _grow(before: _Piece, parent: int, size: tuple[float, float], angle: float, side: Array) -> _Piece:
    """Return a bronchus that leaves another one, bending by an angle (rad) towards `side` over its first half.

    size: diameter and length, mm. side: unit vector (3,) across the end of the one before.
    """
    diameter, length = size
    count = max(4, round(length / TREE_SPACING_MM))
    s = np.linspace(0.0, length, count + 1)
    # The tangent turns evenly over the first half of the bronchus, so that centrelines have no corner.
    turned = angle * np.minimum(2 * s / length, 1.0)
    tangent = np.cos(turned)[:, None] * before.direction + np.sin(turned)[:, None] * side
    steps = (tangent[1:] + tangent[:-1]) / 2 * (length / count)
    points = before.points[-1] + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])
    start = float(before.radius[-1])
    radius = np.interp(s, [0.0, min(start, length / 2)], [start, diameter / 2])
    # The plane in which it bends has this normal; its own children part across it.
    normal = np.cross(tangent[-1], np.cross(before.direction, side))
    return _Piece(points, radius, parent, np.asarray(normal / np.linalg.norm(normal)))


def _room_between(child: _Piece, others: list[_Piece]) -> float:
    """Return the least tissue, mm, between the outer half of a bronchus and others that are not its parent."""
    if not others:
        return math.inf
    points = np.vstack([piece.points for piece in others])
    radius = np.concatenate([piece.radius for piece in others])
    outer = slice(len(child.points) // 2, None)
    away, nearest = cKDTree(points).query(child.points[outer])
    widest = 1 + MAX_DEVIATIONS * UNEVENNESS
    return float((away - widest * (radius[nearest] + child.radius[outer])).min())


def draw_mask(
    tree: Branches, spacing: float = 0.6, unevenness: float = UNEVENNESS, seed: int = 0, margin: float = 4.0
) -> LumenMask:
    """Draw the mask of a tree, with sections that are not round.

    Parameters
    ----------
    tree : Branches
        Branches with radii, mm in LPS.
    spacing : float
        Side of a voxel, mm.
    unevenness : float
        Standard deviation of the wall's distance from the centreline, as a part of the local radius; 0 for round
        sections.
    seed : int
        Seed of the random field.
    margin : float
        Room around the tree, mm.

    Returns
    -------
    LumenMask
        Voxels, and the transform from their indices to mm in LPS.

    Raises
    ------
    OptionError
        A number is out of its range, or a branch has no radii.

    Examples
    --------
    >>> mask = draw_mask(synthetic_tree(seed=1, ends=2), spacing=2.0)
    >>> mask.voxels.ndim, bool(mask.voxels.any())
    (3, True)
    """
    number(OptionError, "spacing", spacing, lambda x: 0 < x < math.inf, "be positive", " mm")
    number(OptionError, "unevenness", unevenness, lambda x: 0 <= x < 0.5, "lie in [0, 0.5)")
    whole_number(OptionError, "seed", seed, 0)
    radii = [branch.radius for branch in tree.branches if branch.radius is not None]
    if len(radii) < len(tree.branches):
        raise OptionError("a branch of the tree has no radii; a mask cannot be drawn of it")
    points, first = np.unique(np.vstack([branch.points for branch in tree.branches]), axis=0, return_index=True)
    radius = np.concatenate(radii)[first]
    low = points.min(axis=0) - radius.max() - margin
    shape = np.ceil((points.max(axis=0) + radius.max() + margin - low) / spacing).astype(int) + 1
    noise = np.zeros(shape, np.float32)
    if unevenness:
        noise = np.random.default_rng(seed).standard_normal(shape, dtype=np.float32)
        noise = gaussian_filter(noise, CORRELATION_MM / spacing)
        noise = unevenness * np.clip(noise / noise.std(), -MAX_DEVIATIONS, MAX_DEVIATIONS)
    voxels = np.zeros(shape, bool)
    for point, r in zip(points, radius, strict=True):
        reach = r * (1 + MAX_DEVIATIONS * unevenness)
        start = np.maximum(np.floor((point - reach - low) / spacing).astype(int), 0)
        stop = np.minimum(np.ceil((point + reach - low) / spacing).astype(int) + 1, shape)
        box = tuple(slice(a, b) for a, b in zip(start, stop, strict=True))
        x, y, z = (low[axis] + spacing * np.arange(start[axis], stop[axis]) - point[axis] for axis in range(3))
        square = x[:, None, None] ** 2 + y[:, None] ** 2 + z**2
        voxels[box] |= square <= (r * (1 + noise[box])) ** 2
    affine = np.diag([spacing, spacing, spacing, 1.0])
    affine[:3, 3] = low
    return LumenMask(voxels, affine)


def write_mask(path: str | Path, mask: LumenMask) -> None:
    """Write a mask as NIfTI.

    Parameters
    ----------
    path : str or Path
        The file, whose name ends in .nii or .nii.gz; it is replaced.
    mask : LumenMask
        The mask.

    Raises
    ------
    OptionError
        nibabel is missing.
    """
    nifti1 = import_extra("nibabel.nifti1")
    # NIfTI has RAS coordinates.
    to_ras = np.linalg.inv(IMAGE_SPACE_TO_LPS["RAS"]) @ mask.affine
    nifti1.save(nifti1.Nifti1Image(mask.voxels.astype(np.uint8), to_ras), path)
