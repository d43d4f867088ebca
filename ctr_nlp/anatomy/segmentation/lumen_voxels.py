"""Which voxels of an image are the lumen: of a mask, of labels, of segments, of a probability map.

Nothing is guessed where an image holds more than one thing: it is refused with a list of what it holds, and a
person states what is lumen.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.formats.images import Image, Segment
from ctr_nlp.anatomy.reading import ReadOptions
from ctr_nlp.exceptions import CurveError
from ctr_nlp.typing import Flags

MAX_LISTED_LABELS = 10
MAX_LABELS = 300
"""An image with more values than this is a scan, or a probability map, and not labelled."""

Voxels = npt.NDArray[Any]


def select_lumen(image: Image, options: ReadOptions) -> tuple[Flags, tuple[str, ...]]:
    """Return where an image is lumen, (l, m, n), and notes; raise CurveError where that is not clear.

    image: of a file. options: what a person states about it; of segment, labels and threshold at most one.
    """
    given = [
        name
        for name, value in (
            ("--segment", options.segment),
            ("--label", options.labels or None),
            ("--threshold", options.threshold),
        )
        if value is not None
    ]
    if len(given) > 1:
        raise CurveError(f"{' and '.join(given)} exclude each other: give one of them")
    image_voxels = image.voxels
    notes = list[str]()
    if image_voxels.dtype.kind == "f":
        missing = ~np.isfinite(image_voxels)
        if missing.any():
            image_voxels = np.where(missing, 0, image_voxels)
            notes.append(f"{int(missing.sum())} voxels are no finite numbers: they are taken as outside the lumen")
    if options.segment is not None:
        lumen = _segment_voxels(image_voxels, _named_segment(image, options.segment))
    elif image_voxels.ndim == 4:
        raise CurveError(_list_segments(image_voxels, image.segments))
    elif options.threshold is not None:
        lumen = _above_threshold(image_voxels, options.threshold)
    elif options.labels:
        lumen = _pick_labels(image_voxels, options.labels)
    else:
        lumen = _only_value(image_voxels, image.segments)
    if not lumen.any():
        raise CurveError("none of its voxels is lumen")
    if lumen.all():
        raise CurveError("all of its voxels are lumen; those outside it must have another value")
    return lumen, tuple(notes)


def _named_segment(image: Image, name: str) -> Segment:
    """Return the segment of a name, exact or but for capitals; raise CurveError where there is none."""
    if not image.segments:
        raise CurveError(
            f"segment is {name!r}, but the file names no segments; --label N chooses by the voxels' value"
        )
    for fold in (str, str.casefold):
        found = [segment for segment in image.segments if fold(segment.name.strip()) == fold(name.strip())]
        if len(found) > 1:
            raise CurveError(f"{len(found)} segments are named {name!r}; rename them in Slicer")
        if found:
            return found[0]
    raise CurveError(f"no segment is named {name!r}: {_list_segments(image.voxels, image.segments)}")


def _segment_voxels(voxels: Voxels, segment: Segment) -> Flags:
    """Return where the voxels (l, m, n), or in layers (k, l, m, n), are a segment."""
    layers = len(voxels) if voxels.ndim == 4 else 1
    if segment.layer >= layers:
        raise CurveError(f"segment {segment.name!r} is in layer {segment.layer}, but there are {layers}, from 0")
    lumen = (voxels[segment.layer] if voxels.ndim == 4 else voxels) == segment.label
    if not lumen.any():
        raise CurveError(f"segment {segment.name!r} is empty: no voxel has its value, {segment.label}")
    return np.asarray(lumen)


def _above_threshold(voxels: Voxels, threshold: float) -> Flags:
    """Return where voxels (l, m, n) are at least `threshold`; raise CurveError where all or none of them are."""
    lumen = np.asarray(voxels >= threshold)
    if lumen.any() and not lumen.all():
        return lumen
    raise CurveError(
        f"threshold is {threshold:g}, but the voxels lie between {voxels.min():g} and {voxels.max():g}; it must "
        "be above the first and at most the second"
    )


def _pick_labels(voxels: Voxels, labels: tuple[int, ...]) -> Flags:
    """Return where voxels (l, m, n) have one of some labels; raise CurveError where one of these is nowhere."""
    if 0 in labels:
        raise CurveError("label is 0, which is the background; labels of a lumen are other numbers")
    for label in labels:
        if not (voxels == label).any():
            raise CurveError(f"no voxel has the label {label}: {_describe_values(voxels, ())}")
    return np.isin(voxels, labels)


def _only_value(voxels: Voxels, segments: tuple[Segment, ...]) -> Flags:
    """Return where a mask (l, m, n) is not 0; raise CurveError, which lists what it holds, where it has several
    values.

    segments: those that the file names.
    """
    lumen = np.asarray(voxels != 0)
    if not lumen.any():
        raise CurveError("its voxels are all 0; those of the lumen must have another value")
    inside = voxels[lumen]
    if (inside != inside[0]).any():
        raise CurveError(_describe_values(voxels, segments))
    if lumen.all():
        raise CurveError(f"its voxels are all {inside[0]:g}; those outside the lumen must be 0")
    return lumen


def _describe_values(voxels: Voxels, segments: tuple[Segment, ...]) -> str:
    """Describe the values of voxels (l, m, n), and which option chooses among them.

    segments: those that the file names.
    """
    if segments:
        return _list_segments(voxels, segments)
    values, counts = np.unique(voxels, return_counts=True)
    if (values != np.rint(values)).any():
        return (
            f"its voxels lie between {values[0]:g} and {values[-1]:g} and are no whole numbers, as in a "
            "probability map: give the value from which a voxel is lumen, as --threshold 0.5"
        )
    labels = [(value, count) for value, count in zip(values.tolist(), counts.tolist(), strict=True) if value != 0]
    if len(labels) > MAX_LABELS or values[0] < 0:
        return (
            f"its voxels have {len(values)} values from {values[0]:g} to {values[-1]:g}, as in a scan: segment "
            "the lumen first; of a probability map in whole numbers --threshold says from which value a voxel is "
            "lumen"
        )
    listed = ", ".join(f"{value:g} ({count} voxels)" for value, count in labels[:MAX_LISTED_LABELS])
    more = f" and {len(labels) - MAX_LISTED_LABELS} more" if len(labels) > MAX_LISTED_LABELS else ""
    return f"it has the labels {listed}{more}; choose those that are the lumen with --label N [N ...]"


def _list_segments(voxels: Voxels, segments: tuple[Segment, ...]) -> str:
    """List segments with their sizes, and the option that chooses one; voxels: (l, m, n) or (k, l, m, n)."""
    entries = []
    for segment in segments:
        layer = voxels[min(segment.layer, len(voxels) - 1)] if voxels.ndim == 4 else voxels
        entries.append(f"{segment.name!r} ({int((layer == segment.label).sum())} voxels)")
    return f"it has the segments {', '.join(entries)}; choose the lumen's with --segment NAME"
