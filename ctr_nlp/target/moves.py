"""Curves made of others: pieces, turned round, moved."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ctr_nlp.support.equal import Kept, Value
from ctr_nlp.support.packing import packable
from ctr_nlp.typing import Array, Field


class Path(Protocol):
    """What these are made of: a Curve."""

    @property
    def length(self) -> float:
        """Arc length in mm."""

    @property
    def point(self) -> Field:
        """(n,) -> (n, 3) mm."""

    @property
    def tangent(self) -> Field:
        """(n,) -> (n, 3)."""

    @property
    def curvature(self) -> Field:
        """(n,) -> (n,) 1/mm."""

    @property
    def radius(self) -> Field | None:
        """(n,) -> (n,) mm."""


@packable("piece")
@dataclass(frozen=True, eq=False)
class Piece(Value):
    """A curve from arc length start on, in mm."""

    curve: Path
    start: float

    def at(self, s: Array) -> Array:
        """The curve's arc length, (n,) mm."""
        return s + self.start

    def point(self, s: Array) -> Array:
        """(n, 3) mm."""
        return self.curve.point(self.at(s))

    def tangent(self, s: Array) -> Array:
        """(n, 3), of length 1."""
        return self.curve.tangent(self.at(s))

    def curvature(self, s: Array) -> Array:
        """(n,) 1/mm."""
        return self.curve.curvature(self.at(s))

    def radius(self, s: Array) -> Array:
        """Of the lumen, (n,) mm, where the curve knows it."""
        assert self.curve.radius is not None
        return self.curve.radius(self.at(s))


@packable("turned")
@dataclass(frozen=True, eq=False)
class Turned(Piece):
    """A curve from its last point to its first."""

    start: float = 0.0

    def at(self, s: Array) -> Array:
        """The curve's arc length, (n,) mm."""
        return np.asarray(self.curve.length - s)

    def tangent(self, s: Array) -> Array:
        """(n, 3), of length 1."""
        return -self.curve.tangent(self.at(s))


@packable("moved")
@dataclass(frozen=True, eq=False)
class Moved(Kept):
    """A curve under a rigid transform (4, 4)."""

    curve: Path
    transform: Array

    def point(self, s: Array) -> Array:
        """(n, 3) mm."""
        return np.asarray(self.curve.point(s) @ self.transform[:3, :3].T + self.transform[:3, 3])

    def tangent(self, s: Array) -> Array:
        """(n, 3), of length 1."""
        return np.asarray(self.curve.tangent(s) @ self.transform[:3, :3].T)
