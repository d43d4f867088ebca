"""Results of a plan on Monte Carlo samples of its robot: how many fail, their errors, and what tolerances cost.

A sample fails ("lost" in fields and files) where it snaps, has no equilibrium, or is on another branch of
equilibria than the nominal robot.
"""

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
"""Confidence of the bound on the share of robots that fail."""
MOST_LOST = 0.01
"""Default share of all robots within the tolerances that may fail on a robust plan."""
COSTLY = (*DEVIATION_NAMES, "rotation_lag")
"""Tolerances whose costs are computed, one by one."""


class Spread(NamedTuple):
    """Mean, median and 95 % quantile (`most`) over samples of a length in mm."""

    mean: float
    median: float
    most: float


class ToleranceCost(NamedTuple):
    """Cost of one tolerance of a tube.

    tube: from 1. tolerance: its name, of COSTLY. growth: of e3, mm. share: of the growths of all tolerances. lost:
    how many fail of two robots that differ in it alone, by its standard deviation to either side.
    """

    tube: int
    tolerance: str
    growth: float
    share: float
    lost: int


class FrameLosses(NamedTuple):
    """Frame, from 1, in which `draws` samples first fail, and the length that the robot is out there, mm."""

    frame: int
    draws: int
    length: float


@dataclass(frozen=True, eq=False, repr=False)
class Robustness(ReadOnlyValue):
    """A plan of T frames on n Monte Carlo samples of its robot, moved open loop from aligned tubes.

    seed: of the samples. parts (n, d, 5), lags (n, d): their deviations from the nominal robot, as in
    robot/samples.py. e2 (n, T), mm: NaN in frames without a shape. largest (n,): largest error at equal arc
    length, mm. lost, snapped (n,): frame, from 1, in which a sample first fails or snaps; 0 where it does not.
    margin (n,): least stability margin at or between frames, NaN where nothing can be unstable. clearance,
    contact (n,): least clearance from the wall, and the deepest contacts summed over frames, mm, NaN without a
    wall. cloud (k, n, 26, 3): every fourth point of the shapes in cloud_frames (k,), from 1, mm. growth (d, 6):
    growth of e3 by one tolerance alone, in the order of COSTLY, mm; lost_alone (d, 6): how many of its two robots
    fail. length (T,): extension of the innermost tube, mm.
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
        """Number of samples that fail."""
        return int((self.lost > 0).sum())

    @property
    def lost_share(self) -> float:
        """Share of the samples that fail."""
        return self.lost_count / len(self)

    @property
    def lost_share_bound(self) -> float:
        """Upper bound of the share of all such robots that fail, with 95 % confidence."""
        return upper_bound(self.lost_count, len(self))

    @property
    def e3(self) -> Array:
        """Root mean squares (n,) of e2 over frames, mm."""
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
        """Spread of the least clearances over robots; `most` is their 5 % quantile. None without a wall."""
        found = spread(-self.clearance)
        return None if found is None else Spread(*(-value for value in found))

    @property
    def contacts(self) -> Spread | None:
        """Spread of `contact` over robots; None without a wall."""
        return spread(self.contact)

    def e2_quantiles(self, *shares: float) -> Array:
        """Return quantiles of e2 over robots, (shares, T) in mm, NaN in frames without a shape; shares: 0 to 1."""
        known = np.isfinite(self.e2).any(axis=0)
        found = np.full((len(shares), self.e2.shape[1]), np.nan)
        found[:, known] = np.nanquantile(self.e2[:, known], shares, axis=0)
        return found

    @property
    def losses_by_frame(self) -> list[FrameLosses]:
        """Frames in which samples first fail, in order."""
        frames, counts = np.unique(self.lost[self.lost > 0], return_counts=True)
        found = zip(frames.tolist(), counts.tolist(), strict=True)
        return [FrameLosses(frame, count, float(self.length[frame - 1])) for frame, count in found]

    @property
    def costs(self) -> list[ToleranceCost]:
        """Costs of the tolerances that are not 0, the most costly first."""
        # Some deviations make the motion better by chance: negative growth is no cost, and shares leave it out.
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
        """A sentence with the number of samples that fail, the bound for all such robots, and their mean error."""
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
    """Build a Robustness from the arrays of a plan.npz, by name, and the seed of its samples."""
    return Robustness(
        seed, **{f.name: arrays[SAMPLE_ARRAY_PREFIX + f.name] for f in fields(Robustness) if f.name != "seed"}
    )


def upper_bound(lost: int, count: int, confidence: float = CONFIDENCE) -> float:
    """Return the upper confidence bound of the share of robots that fail, where `lost` of `count` samples do.

    confidence: of the one-sided bound, from 0 to 1. The exact bound of Clopper and Pearson, Biometrika 26, 1934.
    """
    # The share p at which so few failures have the probability 1 - c: sum_{j <= k} C(n, j) p^j (1 - p)^(n - j) =
    # 1 - c, which is the quantile c of the beta distribution of k + 1 and n - k.
    return 1.0 if lost >= count else float(betaincinv(lost + 1, count - lost, confidence))


def spread(values: Array) -> Spread | None:
    """Return the spread of the finite ones of `values` (n,); None without any."""
    known: Flags = np.isfinite(values)
    if not known.any():
        return None
    values = values[known]
    return Spread(float(values.mean()), float(np.median(values)), float(np.quantile(values, 0.95)))
