"""Images of NIfTI and NRRD files; where their voxels lie is read from the header itself, and never guessed."""

from __future__ import annotations

import gzip
import re
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ctr_nlp.anatomy.branch import SPACES
from ctr_nlp.exceptions import CurveError
from ctr_nlp.support.extras import needed
from ctr_nlp.typing import Array

TO_LPS = SPACES | {"LAS": np.diag([1.0, -1.0, 1.0, 1.0])}
"""Coordinate systems that an image may be written in, and what takes each to LPS."""
NIFTI, NRRD = (".nii", ".nii.gz"), (".nrrd", ".nhdr")
FINEST_MM, COARSEST_MM = 0.005, 20.0
"""Spacings outside of these were almost surely written in another unit."""
LONGEST_VOXEL = 4.0
"""Largest ratio of a voxel's sides."""
SKEW = 1e-3
"""Largest cosine of the angle between two axes of an image."""
HEADER = np.dtype(
    {
        "names": [
            "size",
            "dim",
            "bits",
            "pixdim",
            "offset",
            "units",
            "codes",
            "quaternion",
            "shift",
            "sform",
            "magic",
        ],
        "formats": [
            "<i4",
            "(8,)<i2",
            "<i2",
            "(8,)<f4",
            "<f4",
            "u1",
            "(2,)<i2",
            "(3,)<f4",
            "(3,)<f4",
            "(3,4)<f4",
            "S4",
        ],
        "offsets": [0, 40, 72, 76, 108, 123, 252, 256, 268, 280, 344],
        "itemsize": 348,
    }
)
"""What is used of a NIfTI-1 header, https://nifti.nimh.nih.gov/nifti-1."""
UNITS = {1: "metres", 3: "micrometres"}


@dataclass(frozen=True)
class Image:
    """Voxels (l, m, n) of a file; affine (4, 4): from an index to mm in space, the file's coordinate system."""

    voxels: npt.NDArray[Any]
    affine: Array
    space: str

    @property
    def spacing(self) -> Array:
        """Distance in mm between neighbouring voxels along each axis, (3,)."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0))


def read_image(path: str | Path) -> Image:
    """The image of a NIfTI-1 or NRRD file with three axes; raises CurveError."""
    name = Path(path).name.lower()
    if not name.endswith((*NIFTI, *NRRD)):
        allowed = ", ".join((*NIFTI, *NRRD))
        raise CurveError(f"{path} is not a known kind of image; its name must end in {allowed}")
    try:
        affine, space = _nifti(Path(path)) if name.endswith(NIFTI) else _nrrd(Path(path))
        _check(affine)
        return Image(_voxels(path), affine[:, [2, 1, 0, 3]], space)
    except CurveError as error:
        raise CurveError(f"{path}: {error}") from error
    except (OSError, EOFError, zlib.error) as error:
        raise CurveError(f"image {path} cannot be read: {error}") from error


def _voxels(path: str | Path) -> npt.NDArray[Any]:
    """The values of an image, the axis that its header names first being the last one."""
    sitk = needed("SimpleITK")
    try:
        image = sitk.ReadImage(str(path))
    except RuntimeError as error:
        raise CurveError(f"its voxels cannot be read: {str(error).strip().splitlines()[-1]}") from error
    voxels = np.asarray(sitk.GetArrayFromImage(image))
    if voxels.ndim != 3 or voxels.dtype.kind not in "iuf":
        raise CurveError(f"its voxels are {voxels.shape} of {voxels.dtype}; they must be numbers along 3 axes")
    return voxels


def _nifti(path: Path) -> tuple[Array, str]:
    with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as file:
        raw = file.read(HEADER.itemsize)
        bytes_held = file.seek(0, 2)
    if len(raw) < HEADER.itemsize:
        raise CurveError(f"it holds {len(raw)} bytes; a NIfTI-1 header has {HEADER.itemsize}")
    header = np.frombuffer(raw, HEADER)[0]
    if header["size"] != HEADER.itemsize:
        header = np.frombuffer(raw, HEADER.newbyteorder())[0]
    if header["size"] != HEADER.itemsize or header["magic"] not in (b"n+1", b"ni1"):
        raise CurveError("it does not begin with a NIfTI-1 header")
    rank, *shape = (int(size) for size in header["dim"])
    if rank < 3 or any(size != 1 for size in shape[3:rank]) or min(shape[:3]) < 2:
        raise CurveError(f"its shape is {shape[: max(rank, 0)]}; it must have 3 axes")
    bytes_meant = header["offset"] + np.prod(np.array(shape[:rank], float)) * header["bits"] / 8
    if bytes_held < bytes_meant:
        raise CurveError(f"it was cut short: it holds {bytes_held} bytes of {bytes_meant:.0f}")
    if int(header["units"]) & 7 in UNITS:
        raise CurveError(f"its header says {UNITS[int(header['units']) & 7]}; it must be in millimetres")
    sides = header["pixdim"][1:4].astype(float)
    if not (np.isfinite(sides) & (sides > 0)).all():
        raise CurveError(f"its spacing (pixdim) is {sides.tolist()} mm; it must be positive")
    return _nifti_affine(header, sides), "RAS"


def _nifti_affine(header: Any, sides: Array) -> Array:
    """From index to mm, by the header's sform, qform or both."""
    affines, (qform, sform) = {}, header["codes"]
    if qform > 0:
        vector = header["quaternion"].astype(float)
        scalar = np.sqrt(max(0.0, 1 - vector @ vector))
        axes = Rotation.from_quat([*vector, scalar]).as_matrix() * sides
        axes[:, 2] *= -1 if header["pixdim"][0] < 0 else 1
        affines["qform"] = np.column_stack([axes, header["shift"]])
    if sform > 0:
        affines["sform"] = header["sform"].astype(float)
    if not affines:
        raise CurveError("it has no coordinate system: qform_code and sform_code are 0, one must be positive")
    corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * [*header["dim"][1:4], 1]
    places = [corners @ affine.T for affine in affines.values()]
    apart = np.linalg.norm(places[0] - places[-1], axis=1).max()
    if apart > sides.min() / 2:
        raise CurveError(f"its qform and sform place voxels up to {apart:.3g} mm apart; they must agree")
    affine = next(reversed(affines.values()))
    if np.abs(np.linalg.norm(affine[:, :3], axis=0) / sides - 1).max() > 0.01:
        found = np.linalg.norm(affine[:, :3], axis=0).round(6).tolist()
        raise CurveError(f"its spacing is {sides.tolist()} mm by pixdim and {found} mm by sform; they must agree")
    return np.vstack([affine, [0, 0, 0, 1]])


def _nrrd(path: Path) -> tuple[Array, str]:
    lines = []
    with path.open("rb") as file:
        for line in file:
            if not line.strip():
                break
            lines.append(line[:10_000].decode("utf-8", "replace").strip())
    if not lines or not lines[0].startswith("NRRD000"):
        raise CurveError("it does not begin with an NRRD header")
    fields = {key.strip().lower(): value.strip() for key, _, value in (line.partition(":") for line in lines[1:])}
    if fields.get("dimension") != "3":
        raise CurveError(f"its dimension is {fields.get('dimension')}; it must be 3")
    words = re.split(r"[- ]", fields.get("space", ""))
    space = words[0] if len(words) == 1 else "".join(word[:1] for word in words)
    if space.upper() not in TO_LPS:
        raise CurveError(
            f"its space is {fields.get('space')!r}; it must be left-posterior-superior, right-anterior-superior "
            "or left-anterior-superior, or there is no coordinate system"
        )
    units = set(re.findall(r'"([^"]*)"', fields.get("space units", "")))
    if units - {"mm", "millimeter", "millimeters", ""}:
        raise CurveError(f"its space units are {', '.join(sorted(units))}; they must be mm")
    axes, origin = (_vectors(fields, key, count) for key, count in (("space directions", 3), ("space origin", 1)))
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = axes.T, origin[0]
    return affine, space.upper()


def _vectors(fields: dict[str, str], key: str, count: int) -> Array:
    given = fields.get(key, "missing")
    try:
        vectors = [[float(c) for c in each.split(",")] for each in re.findall(r"\(([^)]*)\)", given)]
    except ValueError:
        vectors = []
    if len(vectors) != count or any(len(vector) != 3 for vector in vectors):
        raise CurveError(f"its {key} is {given}; expected (x,y,z) in mm, {count} of them")
    return np.array(vectors)


def _check(affine: Array) -> None:
    if not np.isfinite(affine).all():
        raise CurveError(f"its axes and origin are {affine[:3].tolist()}; they must be finite")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    sides = " x ".join(f"{side:.4g}" for side in spacing)
    if spacing.min() < FINEST_MM or spacing.max() > COARSEST_MM:
        raise CurveError(
            f"its spacing is {sides} mm; it must lie between {FINEST_MM:g} and {COARSEST_MM:g} mm (was it written "
            "in metres or micrometres?)"
        )
    if spacing.max() > LONGEST_VOXEL * spacing.min():
        raise CurveError(f"its spacing is {sides} mm; no side may be over {LONGEST_VOXEL:g} times another")
    axes = affine[:3, :3] / spacing
    skew = np.abs(axes.T @ axes - np.eye(3)).max()
    if skew > SKEW:
        raise CurveError(f"its axes are {np.degrees(np.arcsin(skew)):.2g} degrees from perpendicular; resample it")
