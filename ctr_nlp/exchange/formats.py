"""The formats in which plans are written for other programs, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ctr_nlp.exchange.gltf import OPENING as GLTF_OPENING
from ctr_nlp.exchange.gltf import OPENING_AT, gltf
from ctr_nlp.exchange.mat import OPENING as MAT_OPENING
from ctr_nlp.exchange.mat import mat
from ctr_nlp.exchange.table import OPENING as TABLE_OPENING
from ctr_nlp.exchange.table import shapes_csv
from ctr_nlp.plan.plan import Plan


@dataclass(frozen=True)
class File:
    """A format of one file. of: the bytes of a plan's file; opening: what those have at byte `at`."""

    of: Callable[[Plan], bytes]
    suffix: str
    opening: str
    at: int = 0


FILES = {
    "gltf": File(gltf, ".glb", GLTF_OPENING, OPENING_AT),
    "mat": File(mat, ".mat", MAT_OPENING),
    "shapes-csv": File(shapes_csv, "_shapes.csv", TABLE_OPENING),
}
"""Formats of one file, by name."""

SLICER = "slicer"
"""The format that is a folder; see slicer.py."""

FORMATS = (SLICER, *FILES)
