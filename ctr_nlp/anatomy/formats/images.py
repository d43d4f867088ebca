"""Images of NIfTI and NRRD files; the position of their voxels is taken from the header, and never guessed.

nibabel and pynrrd read headers and voxels. Errors that nibabel would repair silently when it opens a file
(spacings that are 0 or negative) are refused here, so that its header is read without its checks.
"""

from __future__ import annotations

import gzip
import itertools
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import CENTRELINE_SPACE_TO_LPS, name_source_in_errors
from ctr_nlp.exceptions import CtrError, CurveError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

IMAGE_SPACE_TO_LPS = CENTRELINE_SPACE_TO_LPS | {"LAS": np.diag([1.0, -1.0, 1.0, 1.0])}
"""Coordinate systems in which an image may be written, and the transform (4, 4) from each to LPS."""
NIFTI_SUFFIXES, NRRD_SUFFIXES = (".nii", ".nii.gz"), (".nrrd", ".nhdr")
FINEST_MM, COARSEST_MM = 0.005, 20.0
"""Spacings outside of these were almost surely written in another unit."""
LONGEST_VOXEL = 4.0
"""Largest ratio of a voxel's sides."""
SKEW = 1e-3
"""Largest cosine of the angle between two axes of an image."""
HEADER_BYTES = 348
"""Of NIfTI-1."""
REFUSED_NIFTI_UNITS = {1: "metres", 3: "micrometres"}


@dataclass(frozen=True)
class Image:
    """Voxels (l, m, n) of a file; affine (4, 4): from an index to mm in space, the file's coordinate system."""

    voxels: npt.NDArray[Any]
    affine: Array
    space: str

    @property
    def spacing(self) -> Array:
        """Distances (3,) in mm between neighbouring voxels, by axis."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0))


def read_image(path: str | Path) -> Image:
    """Read the image of a NIfTI-1 or NRRD file with three axes.

    path: the file, whose suffix decides which. Raises CurveError, and OptionError where the reader is not
    installed.
    """
    name = Path(path).name.lower()
    if not name.endswith((*NIFTI_SUFFIXES, *NRRD_SUFFIXES)):
        allowed = ", ".join((*NIFTI_SUFFIXES, *NRRD_SUFFIXES))
        raise CurveError(f"{path} is not a known kind of image; its name must end in {allowed}")
    try:
        with name_source_in_errors(path):
            voxels, affine, space = _nifti(Path(path)) if name.endswith(NIFTI_SUFFIXES) else _nrrd(Path(path))
    except CtrError:
        raise
    except Exception as error:  # whatever the readers of both formats meet in a damaged file
        raise CurveError(f"image {path} cannot be read: {_one_line_message(error)}") from error
    if voxels.ndim != 3 or voxels.dtype.kind not in "iuf":
        raise CurveError(
            f"{path}: its voxels are {voxels.shape} of {voxels.dtype}; they must be numbers along 3 axes"
        )
    # Both formats store the first axis fastest. Transposed, with the affine's columns in the same new order, the
    # array is contiguous as numpy has it.
    return Image(voxels.T, affine[:, [2, 1, 0, 3]], space)


def _nifti(path: Path) -> tuple[npt.NDArray[Any], Array, str]:
    nifti1 = import_extra("nibabel.nifti1")
    arrayproxy = import_extra("nibabel.arrayproxy")
    with gzip.open(path) if path.name.lower().endswith(".gz") else path.open("rb") as file:
        raw = file.read(HEADER_BYTES)
        bytes_held = file.seek(0, 2)
    if len(raw) < HEADER_BYTES:
        raise CurveError(f"it holds {len(raw)} bytes; a NIfTI-1 header has {HEADER_BYTES}")
    header = nifti1.Nifti1Header(raw, check=False)
    if header["sizeof_hdr"] != HEADER_BYTES or header["magic"].item() != b"n+1":
        raise CurveError("it does not begin with a NIfTI-1 header")
    rank, *shape = (int(size) for size in header["dim"])
    if rank < 3 or any(size != 1 for size in shape[3:rank]) or min(shape[:3]) < 2:
        raise CurveError(f"its shape is {shape[: max(rank, 0)]}; it must have 3 axes")
    bytes_meant = float(header["vox_offset"]) + math.prod(shape[:3]) * int(header["bitpix"]) / 8
    if not bytes_held >= bytes_meant:
        raise CurveError(f"it was cut short: it holds {bytes_held} bytes of {bytes_meant:.0f}")
    # The three lowest bits are the unit of length; higher ones are that of time.
    if int(header["xyzt_units"]) & 7 in REFUSED_NIFTI_UNITS:
        raise CurveError(
            f"its header says {REFUSED_NIFTI_UNITS[int(header['xyzt_units']) & 7]}; it must be in millimetres"
        )
    sides = header["pixdim"][1:4].astype(float)
    if not (np.isfinite(sides) & (sides > 0)).all():
        raise CurveError(f"its spacing (pixdim) is {sides.tolist()} mm; it must be positive")
    affine = _nifti_affine(header, shape[:3], sides)
    _check(affine)
    header["pixdim"][4:] = 1.0
    voxels = np.asarray(arrayproxy.ArrayProxy(str(path), header, mmap=False))
    return voxels.reshape(shape[:3], order="F"), affine, "RAS"


def _nifti_affine(header: Any, shape: list[int], sides: Array) -> Array:
    """Return the transform (4, 4) from index to mm by the header's sform or qform; both must agree.

    shape: number of voxels (3,). sides: their sides (3,), mm.
    """
    # qfac, which mirrors the third axis where it is -1; by the standard (nifti1.h) any other value stands for 1.
    header["pixdim"][0] = -1.0 if header["pixdim"][0] < 0 else 1.0
    affines = {}
    for name, found in (("qform", header.get_qform), ("sform", header.get_sform)):
        if header[f"{name}_code"] > 0:
            affines[name] = np.asarray(found(), dtype=float)
    if not affines:
        raise CurveError("it has no coordinate system: qform_code and sform_code are 0, one must be positive")
    corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * [*shape, 1]
    places = [corners @ affine.T for affine in affines.values()]
    apart = np.linalg.norm(places[0] - places[-1], axis=1).max()
    if apart > sides.min() / 2:
        raise CurveError(f"its qform and sform place voxels up to {apart:.3g} mm apart; they must agree")
    # sform, where it is there, as in nibabel.
    affine = next(reversed(affines.values()))
    if np.abs(np.linalg.norm(affine[:3, :3], axis=0) / sides - 1).max() > 0.01:
        found = np.linalg.norm(affine[:3, :3], axis=0).round(6).tolist()
        raise CurveError(f"its spacing is {sides.tolist()} mm by pixdim and {found} mm by sform; they must agree")
    return affine


def _nrrd(path: Path) -> tuple[npt.NDArray[Any], Array, str]:
    nrrd = import_extra("nrrd")
    with path.open("rb") as file:
        if not file.read(7) == b"NRRD000":
            raise CurveError("it does not begin with an NRRD header")
    fields = _nrrd_fields(nrrd, path)
    if fields.get("dimension") != 3:
        raise CurveError(f"its dimension is {fields.get('dimension')}; it must be 3")
    words = re.split(r"[- ]", fields.get("space", ""))
    space = words[0] if len(words) == 1 else "".join(word[:1] for word in words)
    if space.upper() not in IMAGE_SPACE_TO_LPS:
        raise CurveError(
            f"its space is {fields.get('space')!r}; it must be left-posterior-superior, right-anterior-superior "
            "or left-anterior-superior, or there is no coordinate system"
        )
    units = set(fields.get("space units", []))
    if units - {"mm", "millimeter", "millimeters", ""}:
        raise CurveError(f"its space units are {', '.join(sorted(units))}; they must be mm")
    affine = np.eye(4)
    parts = ("space directions", affine[:3, :3].T, 3), ("space origin", affine[:3, 3], 1)
    for key, part, count in parts:
        given = np.asarray(fields.get(key, np.nan), dtype=float)
        if given.shape != part.shape:
            told = f"{fields[key]}".replace("\n", "") if key in fields else "missing"
            raise CurveError(f"its {key} is {told}; expected (x,y,z) in mm, {count} of them")
        part[...] = given
    _check(affine)
    try:
        return nrrd.read(str(path))[0], affine, space.upper()
    except Exception as error:  # whatever its decompressors meet
        raise CurveError(f"its voxels cannot be read: {_one_line_message(error)}") from error


def _nrrd_fields(nrrd: Any, path: Path) -> dict[str, Any]:
    """Return the header's fields; where it cannot be read, raise CurveError that names the field at fault."""
    try:
        return dict(nrrd.read_header(str(path)))
    except Exception as error:  # whatever its readers of fields meet
        with path.open("rb") as file:
            header = [line[:10_000].decode("utf-8", "replace") for line in itertools.takewhile(bytes.strip, file)]
        for line in header[1:]:
            try:
                nrrd.read_header([header[0], line])
            except Exception as wrong:
                field, _, value = line.strip().partition(":")
                raise CurveError(f"its {field} is {value.strip()}: {_one_line_message(wrong)}") from error
        raise


def _one_line_message(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


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
