"""Vectors of three components: numbers, columns or rows of numbers, or symbols, with one code for all of these."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ctr_nlp.typing import Vector


def vectors(values: Sequence[Any]) -> list[Vector]:
    """Split values into vectors of three, one after the other."""
    return [(values[k], values[k + 1], values[k + 2]) for k in range(0, len(values), 3)]


def dot(a: Vector, b: Vector) -> Any:
    """Return the scalar product a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def cross(a: Vector, b: Vector) -> Vector:
    """Return the vector product a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def scale_vector(factor: Any, a: Vector) -> Vector:
    """Return factor times a."""
    return factor * a[0], factor * a[1], factor * a[2]


def plus(a: Vector, factor: Any, b: Vector) -> Vector:
    """Return a plus factor times b."""
    return a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]


def total(vectors: Sequence[Vector]) -> Vector:
    """Return the sum of vectors; zeros without any."""
    x, y, z = (sum(vector[k] for vector in vectors) for k in range(3))
    return x, y, z
