"""Vectors of three numbers, columns, rows or symbols each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ctr_nlp.typing import Vector


def vectors(values: Sequence[Any]) -> list[Vector]:
    """Three values after three."""
    return [(values[k], values[k + 1], values[k + 2]) for k in range(0, len(values), 3)]


def dot(a: Vector, b: Vector) -> Any:
    """Scalar product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def scaled(factor: Any, a: Vector) -> Vector:
    """Factor times a."""
    return factor * a[0], factor * a[1], factor * a[2]


def plus(a: Vector, factor: Any, b: Vector) -> Vector:
    """The sum of a and factor times b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


def total(vectors: Sequence[Vector]) -> Vector:
    """Their sum."""
    x, y, z = (sum(vector[k] for vector in vectors) for k in range(3))
    return x, y, z
