"""What is measured: pure functions from problems to records; ratios are taken within one run."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

RATIO = 0.4
"""Part of a ratio by which it may be worse than its baseline: machines differ."""


@dataclass(frozen=True)
class Record:
    """One figure. better: whether more or less of it is. tolerance: the part by which it may be worse than its
    baseline; None where it depends on the machine and is shown only.
    """

    name: str
    value: float
    unit: str
    better: str
    tolerance: float | None = None


def regressions(records: Iterable[Record], baseline: Mapping[str, float]) -> list[str]:
    """What has become worse than its tolerance allows, in words; figures without a baseline are left out."""
    found = []
    for record in records:
        if record.tolerance is None or record.name not in baseline:
            continue
        before = baseline[record.name]
        worse = record.value < before * (1 - record.tolerance)
        if record.better == "less":
            worse = record.value > before * (1 + record.tolerance)
        if worse or record.value != record.value:
            found.append(
                f"{record.name}: {record.value:.4g}, was {before:.4g}; {record.better} is better and "
                f"{record.tolerance:.0%} is tolerated"
            )
    return found
