"""The formats in which plans are written for other programs, by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from ctr_nlp.plan.plan import Plan
from ctr_nlp.view.exchange.gltf import GLTF_SIGNATURE as GLTF_OPENING
from ctr_nlp.view.exchange.gltf import GLTF_SIGNATURE_OFFSET, encode_gltf
from ctr_nlp.view.exchange.mat import MAT_SIGNATURE as MAT_OPENING
from ctr_nlp.view.exchange.mat import encode_mat
from ctr_nlp.view.exchange.shapes_csv import SHAPES_CSV_SIGNATURE as TABLE_OPENING
from ctr_nlp.view.exchange.shapes_csv import encode_shapes_csv


@dataclass(frozen=True)
class FileFormat:
    """Format that writes a plan as one file.

    encode: returns the bytes of a plan's file. suffix: of the file's name. signature: text that each such file has
    at byte `signature_offset`, by which a file of ours is recognised before it is replaced.
    """

    encode: Callable[[Plan], bytes]
    suffix: str
    signature: str
    signature_offset: int = 0


FILE_FORMATS = {
    "gltf": FileFormat(encode_gltf, ".glb", GLTF_OPENING, GLTF_SIGNATURE_OFFSET),
    "mat": FileFormat(encode_mat, ".mat", MAT_OPENING),
    "shapes-csv": FileFormat(encode_shapes_csv, "_shapes.csv", TABLE_OPENING),
}
"""Formats that write one file, by name."""

SLICER_FORMAT = "slicer"
"""The format that writes a folder; see slicer.py."""

EXCHANGE_FORMATS = (SLICER_FORMAT, *FILE_FORMATS)
