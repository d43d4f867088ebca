"""Results of a plan on robots that differ from the one described: how many are lost, and their errors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np
from scipy.special import betaincinv

from ctr_nlp.robot.tolerances import DEVIATION_NAMES
from ctr_nlp.support.value_objects import ReadOnlyValue
from ctr_nlp.typing import Array, Flags, Index

SAMPLE_ARRAY_PREFIX = "draws_"
"""Prefix of the names of these arrays in plan.npz."""
CONFIDENCE = 0.95
"""Confidence of the bound on the share of lost robots."""
MOST_LOST = 0.01
"""The share of all robots within the tolerances that may be lost on a robust plan, unless another is asked for."""
COSTLY = (*DEVIATION_NAMES, "rotation_lag")
"""Tolerances whose costs are found, one by one."""


class Spread(NamedTuple):
    """Mean and median over draws of a length in mm, and what 95 % of the draws do not exceed."""

    mean: float
    median: float
    most: float


class ToleranceCost(NamedTuple):
    """Cost of one tolerance of a tube, counted from 1: e3 grows by `growth` mm; share: of the growths of all
    tolerances.

    lost: how many of two robots are lost that differ in it alone, by its standard deviation to either side.
    """

    tube: int
    tolerance: str
    growth: float
    share: float
    lost: int


class FrameLosses(NamedTuple):
    """Frame, from 1, in which `draws` robots are lost first, and how far the robot is out there, mm."""

    frame: int
    draws: int
    length: float


@dataclass(frozen=True, eq=False, repr=False)
class Robustness(ReadOnlyValue):
    """A plan of T frames on n draws of its robot, moved open loop from where all tubes are aligned.

    seed: of the draws; parts (n, d, 5), lags (n, d): by how much they differ from the robot described, as in
    robot.draws. e2 (n, T) and largest (n,), the largest error at equal arc length, mm, NaN where a frame or all
    frames have no shape. lost, snapped (n,): in which frame, from 1, a draw is lost or snaps first; 0 where not.
    margin (n,): least stability margin at or between frames, NaN where nothing can be unstable. clearance,
    contact (n,): least clearance from the wall, and the depths of the deepest contacts summed over frames, mm, NaN
    without a wall. cloud (k, n, 26, 3): every fourth sample of the shapes at cloud_frames (k,), from 1, mm.
    growth (d, 6): by how much e3 grows, mm, where the robot differs by one tolerance alone, as COSTLY, and
    lost_alone (d, 6): how many of two such robots are lost. length (T,): how far the robot is out, mm.
    """

    seed: int
    parts: Array
    lags: Array
    e2: Array
    largest: Array
    lost: Index
    snapped: Index
    margin: Array
    clearance: Array
    contact: Array
    cloud: Array
    cloud_frames: Index
    growth: Array
    lost_alone: Index
    length: Array

    def __len__(self) -> int:
        return len(self.parts)

    def __repr__(self) -> str:
        return f"Robustness({self.summary_sentence.rstrip('.')})"

    @property
    def lost_count(self) -> int:
        """Number of robots that are lost."""
        return int((self.lost > 0).sum())

    @property
    def lost_share(self) -> float:
        """Share of the robots that are lost."""
        return self.lost_count / len(self)

    @property
    def lost_share_bound(self) -> float:
        """Upper bound of the share of all such robots that are lost, with 95 % confidence."""
        return upper_bound(self.lost_count, len(self))

    @property
    def e3(self) -> Array:
        """Root mean squares (n,) over frames of e2, mm."""
        known = np.isfinite(self.e2)
        sums = (np.where(known, self.e2, 0.0).astype(float) ** 2).sum(axis=1)
        counts = known.sum(axis=1)
        return np.asarray(np.sqrt(np.divide(sums, counts, out=np.full(len(self), np.nan), where=counts > 0)))

    @property
    def errors(self) -> Spread | None:
        """Spread of e3 over robots; None where no robot has a shape."""
        return spread(self.e3)

    @property
    def largest_errors(self) -> Spread | None:
        """Spread of the largest errors over robots; None where no robot has a shape."""
        return spread(self.largest)

    @property
    def clearances(self) -> Spread | None:
        """Spread of the least clearances over robots; `most` is what 95 % of them exceed. None without a wall."""
        found = spread(-self.clearance)
        return None if found is None else Spread(*(-value for value in found))

    @property
    def contacts(self) -> Spread | None:
        """Spread of `contact` over robots; None without a wall."""
        return spread(self.contact)

    def e2_quantiles(self, *shares: float) -> Array:
        """Quantiles of e2 over robots in every frame, (shares, T) mm, at shares from 0 to 1; NaN in frames without
        a shape.
        """
        known = np.isfinite(self.e2).any(axis=0)
        found = np.full((len(shares), self.e2.shape[1]), np.nan)
        found[:, known] = np.nanquantile(self.e2[:, known], shares, axis=0)
        return found

    @property
    def losses_by_frame(self) -> list[FrameLosses]:
        """Frames in which robots are lost first, in order."""
        frames, counts = np.unique(self.lost[self.lost > 0], return_counts=True)
        found = zip(frames.tolist(), counts.tolist(), strict=True)
        return [FrameLosses(frame, count, float(self.length[frame - 1])) for frame, count in found]

    @property
    def costs(self) -> list[ToleranceCost]:
        """Costs of the tolerances that are not 0, the most costly first."""
        total = max(float(np.nansum(np.maximum(self.growth, 0.0))), 1e-12)
        found = [
            ToleranceCost(
                i + 1, COSTLY[k], float(self.growth[i, k]), max(float(self.growth[i, k]), 0.0) / total, int(lost)
            )
            for (i, k), lost in np.ndenumerate(self.lost_alone)
            if np.isfinite(self.growth[i, k])
        ]
        return sorted(found, key=lambda cost: -cost.growth)

    @property
    def summary_sentence(self) -> str:
        """Say in a sentence how many samples are lost, the bound for all such robots, and their mean error."""
        lost = self.lost_count
        errors = self.errors
        mean = f"; e3 is {errors.mean:.3g} mm on average over the samples" if errors else ""
        bound = f"95 % bound for all such robots: {100 * self.lost_share_bound:.1f} %"
        return f"{lost} of {len(self)} samples snap or end on another branch ({bound}){mean}."

    def summary(self) -> dict[str, Any]:
        """Return the entries of summary.json on the simulated robots."""
        spreads = {
            "e3": self.errors,
            "e_max": self.largest_errors,
            "clearance": self.clearances,
            "contact_depth": self.contacts,
        }
        return {
            "draws": len(self),
            "seed": self.seed,
            "lost": self.lost_count,
            "snapped": int((self.snapped > 0).sum()),
            "lost_share": self.lost_share,
            "lost_at_most": self.lost_share_bound,
            "lost_when": [loss._asdict() for loss in self.losses_by_frame],
            **{name: None if found is None else found._asdict() for name, found in spreads.items()},
            "costs": [cost._asdict() for cost in self.costs],
        }

    def arrays(self) -> dict[str, Array]:
        """Return the arrays under their names in plan.npz."""
        return dict(self._arrays())

    def _arrays(self) -> Iterator[tuple[str, Array]]:
        for f in fields(self):
            if f.name != "seed":
                yield SAMPLE_ARRAY_PREFIX + f.name, getattr(self, f.name)


def robustness_from_arrays(arrays: Mapping[str, Any], seed: int) -> Robustness:
    """Make a Robustness of the arrays of a plan.npz and the seed of its robots."""
    return Robustness(
        seed, **{f.name: arrays[SAMPLE_ARRAY_PREFIX + f.name] for f in fields(Robustness) if f.name != "seed"}
    )


def upper_bound(lost: int, count: int, confidence: float = CONFIDENCE) -> float:
    """Return the largest share of lost robots at which so few as `lost` of `count` would be with probability 1 -
    confidence.

    Clopper and Pearson, Biometrika 26, 1934: the quantile of a beta distribution, for one side.
    """
    return 1.0 if lost >= count else float(betaincinv(lost + 1, count - lost, confidence))


def spread(values: Array) -> Spread | None:
    """Return the spread of the values (n,) that are known, not NaN or infinite; None without any."""
    known: Flags = np.isfinite(values)
    if not known.any():
        return None
    values = values[known]
    return Spread(float(values.mean()), float(np.median(values)), float(np.quantile(values, 0.95)))
