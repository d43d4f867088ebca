"""Images of NIfTI and NRRD files; the position of their voxels is taken from the header, and never guessed.

Where a header leaves the position open, or contradicts itself, a person states which part of it counts.

nibabel and pynrrd read headers and voxels. Errors that nibabel would repair silently when it opens a file
(spacings that are 0 or negative) are refused here, so that its header is read without its checks.
"""

from __future__ import annotations

import gzip
import itertools
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import CENTRELINE_SPACE_TO_LPS, format_point, name_source_in_errors
from ctr_nlp.anatomy.reading import (
    AS_THE_FILE_SAYS,
    ASSUMED,
    GIVEN,
    MM_PER_UNIT,
    NO_FACTS,
    STATED,
    FileFacts,
    ReadOptions,
)
from ctr_nlp.anatomy.suffixes import MASK_SUFFIXES, NIFTI_SUFFIXES
from ctr_nlp.exceptions import CtrError, CurveError
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array

IMAGE_SPACE_TO_LPS = CENTRELINE_SPACE_TO_LPS | {"LAS": np.diag([1.0, -1.0, 1.0, 1.0])}
"""Coordinate systems in which an image may be written, and the transform (4, 4) from each to LPS."""
FINEST_MM, COARSEST_MM = 0.005, 20.0
"""Spacings outside of these were almost surely written in another unit."""
MAX_VOXEL_RATIO, NOTED_VOXEL_RATIO = 10.0, 3.0
"""Largest ratio of a voxel's sides, and that from which a note speaks of accuracy."""
SKEW = 1e-3
"""Largest cosine of the angle between two axes of an image."""
HEADER_BYTES = 348
"""Of NIfTI-1."""
NIFTI_UNITS = {1: "m", 2: "mm", 3: "um"}
"""Codes of the unit of length in a NIfTI header."""
NRRD_UNITS = {
    **dict.fromkeys(("mm", "millimeter", "millimeters", "millimetre", "millimetres"), "mm"),
    **dict.fromkeys(("m", "meter", "meters", "metre", "metres"), "m"),
    **dict.fromkeys(("cm", "centimeter", "centimeters"), "cm"),
    **dict.fromkeys(("um", "micron", "microns", "micrometer", "micrometers"), "um"),
}
SEGMENT_FIELD = re.compile(r"Segment(\d+)_Name$")
"""Field of a segmentation of 3D Slicer that names a segment."""


@dataclass(frozen=True)
class Segment:
    """A segment of a segmentation: its name, its voxels' value, and its layer, where segments may overlap."""

    name: str
    label: int
    layer: int


@dataclass(frozen=True)
class Image:
    """Voxels of a file and where they are.

    voxels: (l, m, n), or (k, l, m, n) for a segmentation of k layers. affine: (4, 4), from an index to mm in
    space, the file's coordinate system. segments: of a segmentation of 3D Slicer. facts: what was found out.
    """

    voxels: npt.NDArray[Any]
    affine: Array
    space: str
    segments: tuple[Segment, ...] = ()
    facts: FileFacts = NO_FACTS

    @property
    def spacing(self) -> Array:
        """Distances (3,) in mm between neighbouring voxels, by axis."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0))


def read_image(path: str | Path, options: ReadOptions = AS_THE_FILE_SAYS) -> Image:
    """Read the image of a NIfTI-1 or NRRD file with three axes, or of a segmentation with layers.

    path: the file, whose suffix decides which. options: what a person states about the file. Raises CurveError,
    and OptionError where the reader is not installed.
    """
    name = Path(path).name.lower()
    if not name.endswith(MASK_SUFFIXES):
        allowed = ", ".join(MASK_SUFFIXES)
        raise CurveError(f"{path} is not a known kind of image; its name must end in {allowed}")
    read = _nifti if name.endswith(NIFTI_SUFFIXES) else _nrrd
    try:
        with name_source_in_errors(path):
            if options.form is not None and read is _nrrd:
                raise CurveError("--form goes with NIfTI files; NRRD files have one transform")
            image = read(Path(path), options)
    except CtrError:
        raise
    except Exception as error:  # whatever the readers of both formats meet in a damaged file
        raise CurveError(f"image {path} cannot be read: {_one_line_message(error)}") from error
    shape, dtype = image.voxels.shape, image.voxels.dtype
    if len(shape) not in ((3, 4) if image.segments else (3,)) or dtype.kind not in "iuf":
        raise CurveError(f"{path}: its voxels are {shape} of {dtype}; they must be numbers along 3 axes")
    # Both formats store the first axis fastest. Transposed, with the affine's columns in the same new order, the
    # array is contiguous as numpy has it.
    layers = image.voxels.ndim - 3
    order = (*range(layers), *range(image.voxels.ndim - 1, layers - 1, -1))
    return replace(image, voxels=image.voxels.transpose(order), affine=image.affine[:, [2, 1, 0, 3]])


def _nifti(path: Path, options: ReadOptions) -> Image:
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
    if float(header["vox_offset"]) % 16 != 0:
        raise CurveError(f"its voxels begin at byte {header['vox_offset']:g}, which is no multiple of 16")
    # The three lowest bits are the unit of length; higher ones are that of time.
    units, units_known = _units(NIFTI_UNITS.get(int(header["xyzt_units"]) & 7), options)
    sides = header["pixdim"][1:4].astype(float)
    if not (np.isfinite(sides) & (sides > 0)).all():
        raise CurveError(f"its spacing (pixdim) is {sides.tolist()} mm; it must be positive")
    affine, space, known, notes = _nifti_affine(header, shape[:3], sides, options)
    affine[:3] *= MM_PER_UNIT[units]
    notes += _check(affine)
    if bytes_held > bytes_meant:
        notes.append(
            f"the file holds {bytes_held - bytes_meant:.0f} bytes more than its header says; is it damaged?"
        )
    header["pixdim"][4:] = 1.0
    voxels = np.asarray(arrayproxy.ArrayProxy(str(path), header, mmap=False))
    facts = FileFacts("mask in a NIfTI file", units, units_known, known, tuple(notes))
    return Image(voxels.reshape(shape[:3], order="F"), affine, space, facts=facts)


def _units(stated: str | None, options: ReadOptions) -> tuple[str, str]:
    """Return the unit of an image's lengths and how it is known; raise CurveError where it is not mm.

    stated: by the file, one of MM_PER_UNIT, or None. options: what a person states, which counts first.
    """
    if options.units is not None:
        return options.units, GIVEN
    if stated not in (None, "mm"):
        raise CurveError(
            f"its header says that lengths are in {stated}; images are in mm. State the unit with --units mm, if "
            f"the header is wrong, or --units {stated}"
        )
    return "mm", ASSUMED if stated is None else STATED


def _nifti_affine(
    header: Any, shape: list[int], sides: Array, options: ReadOptions
) -> tuple[Array, str, str, list[str]]:
    """Return the transform (4, 4) from index to space by the header's sform or qform, the space, how it is known,
    and notes.

    shape: number of voxels (3,). sides: their sides (3,). options: what a person states about the file. Raises
    CurveError where both differ, or there is none, and nobody states what counts.
    """
    # qfac, which mirrors the third axis where it is -1; by the standard (nifti1.h) any other value stands for 1.
    header["pixdim"][0] = -1.0 if header["pixdim"][0] < 0 else 1.0
    forms = {"qform": header.get_qform, "sform": header.get_sform}
    coded = [name for name in forms if header[f"{name}_code"] > 0]
    if options.form is not None:
        affine = np.asarray(forms[options.form](), dtype=float)
        if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) < np.finfo(float).eps:
            others = f"; --form {coded[0]} takes the other one" if coded else ""
            raise CurveError(f"its {options.form} is empty: no axes are stored in it{others}")
        note = f"the {options.form} places the voxels, as given"
        if options.form not in coded:
            note += f"; its code in the header is 0, which means that it is not meant for use ({_axes(affine)})"
        _check_sides(affine, sides, options.form)
        return affine, _nifti_space(options), GIVEN, [note]
    if not coded:
        if options.space is not None:
            affine = np.diag([*sides, 1.0])
            note = f"no transform in the header: axes are taken as {options.space}, the first voxel as the origin"
            return affine, options.space, GIVEN, [note]
        raise CurveError(
            "it has no coordinate system: qform_code and sform_code are 0, one must be positive. Save it with its "
            "position in the scan; or state with --space RAS (or LPS) that its axes point so, and give points in "
            "mm from its first voxel"
        )
    affines = {name: np.asarray(forms[name](), dtype=float) for name in coded}
    corners = np.array([[x, y, z, 1] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * [*shape, 1]
    places = [corners @ affine.T for affine in affines.values()]
    apart = np.linalg.norm(places[0] - places[-1], axis=1).max()
    if apart > sides.min() / 2:
        raise CurveError(
            f"its qform and sform place voxels up to {apart:.3g} mm apart; they must agree, or --form qform or "
            "--form sform says which counts: the one in whose coordinates entry and target are"
        )
    # sform, where it is there, as in nibabel.
    name = coded[-1]
    _check_sides(affines[name], sides, name)
    return affines[name], _nifti_space(options), STATED, []


def _nifti_space(options: ReadOptions) -> str:
    if options.space not in (None, "RAS"):
        raise CurveError(f"space is {options.space}, but NIfTI files are in RAS; leave out --space")
    return "RAS"


def _check_sides(affine: Array, sides: Array, form: str) -> None:
    """Raise CurveError unless the columns of a transform (4, 4) are as long as the voxels' sides (3,).

    form: name of the transform.
    """
    if np.abs(np.linalg.norm(affine[:3, :3], axis=0) / sides - 1).max() > 0.01:
        found = np.linalg.norm(affine[:3, :3], axis=0).round(6).tolist()
        raise CurveError(f"its spacing is {sides.tolist()} mm by pixdim and {found} mm by {form}; they must agree")


def _axes(affine: Array) -> str:
    """Describe where the axes of an image in RAS point."""
    letters = ["RL", "AP", "SI"]
    names = []
    for column in affine[:3, :3].T:
        k = int(np.abs(column).argmax())
        names.append(letters[k][int(column[k] < 0)])
    return f"its axes point to {', '.join(names)}, its first voxel is at {format_point(affine[:3, 3])}"


def _nrrd(path: Path, options: ReadOptions) -> Image:
    nrrd = import_extra("nrrd")
    with path.open("rb") as file:
        if not file.read(7) == b"NRRD000":
            raise CurveError("it does not begin with an NRRD header")
    fields = _nrrd_fields(nrrd, path)
    segments = _segments(fields)
    layered = fields.get("dimension") == 4 and bool(segments)
    if fields.get("dimension") != 3 and not layered:
        raise CurveError(f"its dimension is {fields.get('dimension')}; it must be 3")
    space, space_known = _nrrd_space(fields, options)
    stated = {
        NRRD_UNITS.get(str(unit).strip().lower(), str(unit)) for unit in fields.get("space units", []) if unit
    }
    if len(stated) > 1 or stated - set(MM_PER_UNIT):
        raise CurveError(f"its space units are {', '.join(sorted(stated))}; they must be mm")
    units, units_known = _units(next(iter(stated), None), options)
    directions = np.asarray(fields.get("space directions", np.nan), dtype=float)
    layer_axis = 0
    if layered:
        # The axis of layers has no direction in space.
        without = np.flatnonzero(np.isnan(directions).all(axis=-1)) if directions.shape == (4, 3) else np.zeros(0)
        if len(without) != 1:
            raise CurveError(
                "its dimension is 4, and not one axis without a direction, that of layers of segments"
            )
        layer_axis = int(without[0])
        directions = np.delete(directions, layer_axis, axis=0)
    affine = np.eye(4)
    origin = np.asarray(fields.get("space origin", np.nan), dtype=float)
    parts = ("space directions", affine[:3, :3].T, 3, directions), ("space origin", affine[:3, 3], 1, origin)
    for key, part, count, given in parts:
        if given.shape != part.shape:
            told = f"{fields[key]}".replace("\n", "") if key in fields else "missing"
            raise CurveError(f"its {key} is {told}; expected (x,y,z) in mm, {count} of them")
        part[...] = given
    affine[:3] *= MM_PER_UNIT[units]
    notes = _check(affine)
    try:
        voxels = nrrd.read(str(path))[0]
    except Exception as error:  # whatever its decompressors meet
        raise CurveError(f"its voxels cannot be read: {_one_line_message(error)}") from error
    kind = "segmentation of 3D Slicer" if segments else "mask in an NRRD file"
    facts = FileFacts(kind, units, units_known, space_known, tuple(notes))
    return Image(np.moveaxis(voxels, layer_axis, 0) if layered else voxels, affine, space, segments, facts)


def _nrrd_space(fields: dict[str, Any], options: ReadOptions) -> tuple[str, str]:
    """Return the coordinate system of a header's fields, and how it is known; raise CurveError where it has none.

    options: what a person states about the file.
    """
    words = re.split(r"[- ]", fields.get("space", ""))
    space = (words[0] if len(words) == 1 else "".join(word[:1] for word in words)).upper()
    if "space" not in fields and options.space is not None:
        return options.space, GIVEN
    if space not in IMAGE_SPACE_TO_LPS:
        more = "; --space LPS or --space RAS states it" if "space" not in fields else ""
        raise CurveError(
            f"its space is {fields.get('space')!r}; it must be left-posterior-superior, right-anterior-superior "
            f"or left-anterior-superior, or there is no coordinate system{more}"
        )
    if options.space not in (None, space):
        raise CurveError(f"space is {options.space}, but the file states {space}; leave out --space")
    return space, STATED


def _segments(fields: dict[str, Any]) -> tuple[Segment, ...]:
    """Return the segments that the fields of a header name, in the order of their numbers."""
    numbers = sorted(int(match[1]) for key in fields if (match := SEGMENT_FIELD.match(key)))
    found = []
    for number in numbers:
        # Slicer before 4.11 wrote neither: each segment was a layer of its own, or they were labelled in order.
        several = fields.get("dimension") == 4
        values = []
        for key, default in (("LabelValue", 1 if several else number + 1), ("Layer", number if several else 0)):
            text = str(fields.get(f"Segment{number}_{key}", default)).strip()
            if not re.fullmatch(r"\d{1,9}", text):
                raise CurveError(f"its Segment{number}_{key} is {text!r}; it must be a whole number")
            values.append(int(text))
        found.append(Segment(str(fields[f"Segment{number}_Name"]), values[0], values[1]))
    return tuple(found)


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


def _check(affine: Array) -> list[str]:
    """Return notes on the voxels of a transform (4, 4), mm; raise CurveError where they cannot be used."""
    if not np.isfinite(affine).all():
        raise CurveError(f"its axes and origin are {affine[:3].tolist()}; they must be finite")
    spacing = np.linalg.norm(affine[:3, :3], axis=0)
    sides = " x ".join(f"{side:.4g}" for side in spacing)
    if spacing.min() < FINEST_MM or spacing.max() > COARSEST_MM:
        raise CurveError(
            f"its spacing is {sides} mm; it must lie between {FINEST_MM:g} and {COARSEST_MM:g} mm (was it written "
            "in metres or micrometres? --units states it)"
        )
    ratio = spacing.max() / spacing.min()
    if ratio > MAX_VOXEL_RATIO:
        raise CurveError(
            f"its spacing is {sides} mm; no side may be over {MAX_VOXEL_RATIO:g} times another: resample it"
        )
    axes = affine[:3, :3] / spacing
    skew = np.abs(axes.T @ axes - np.eye(3)).max()
    if skew > SKEW:
        raise CurveError(f"its axes are {np.degrees(np.arcsin(skew)):.2g} degrees from perpendicular; resample it")
    if ratio < NOTED_VOXEL_RATIO:
        return []
    return [
        f"voxels are {sides} mm: along their longest side the wall is known to about {spacing.max() / 2:.2g} mm, "
        "and so are path and radius where the lumen runs across it"
    ]
