"""A plan's own verdicts beside those of the checker: where they disagree, and by how much they may differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ctr_nlp.check import checker
from ctr_nlp.check.checker import NO, NOT_COVERED, SHAPE_VERDICTS, VERDICTS, YES, CheckResult
from ctr_nlp.check.records import DEEP_MM, RECORDS, SAMPLE_SHARE

VERDICT_TOLERANCES = {"arrives": 0.05, "follows": 0.05, "stable": 0.005, "within_wall": 0.1, "holds": SAMPLE_SHARE}
"""By how much numbers of verdicts may differ, and how near to its threshold a number must be where words differ:
mm, of the margin, and share of the samples. The words *solved* and *within_limits* may not differ."""


class Opinion(NamedTuple):
    """A plan's own verdict beside that of the checker.

    Attributes
    ----------
    name : str
        Of the verdict, or of the part of the record.
    own_word, own_number : str, float or None
        The plan's; None for parts of the record.
    word, number : str, float or None
        The checker's: ``"yes"``, ``"no"`` or ``"not covered"``.
    agrees : bool
        False where one says yes and the other no, or their numbers differ by more than their tolerance. What is
        not covered or not checked neither agrees nor disagrees, and counts as True.
    why : str
        The checker's reason.
    """

    name: str
    own_word: str | None
    own_number: float | None
    word: str
    number: float | None
    agrees: bool
    why: str


def compare_verdicts(found: CheckResult, own: Mapping[str, Any]) -> list[Opinion]:
    """Set a plan's own verdicts beside those of the checker.

    Parameters
    ----------
    found : CheckResult
        Of :func:`~ctr_nlp.check.records.check_plan`.
    own : mapping
        The plan's verdicts by name, each with ``word`` and ``number``: ``plan.verdicts._asdict()``. Empty where
        the plan cannot be read.

    Returns
    -------
    list of Opinion
        Verdicts, then parts of the record.
    """
    # Without margins, the plan was evaluated on another model than the checker's elastic one.
    same_model = bool(np.isfinite(found.file.arrays["stability"]).any())
    opinions = []
    for name in (*VERDICTS, *RECORDS):
        finding, verdict = found.findings[name], own.get(name)
        word, number = (None, None) if verdict is None else (verdict.word, verdict.number)
        agrees = name in VERDICTS or finding.word != NO
        if verdict is not None and (same_model or name not in SHAPE_VERDICTS):
            agrees = _agree(name, found, word, number)
        opinions.append(Opinion(name, word, number, finding.word, finding.number, agrees, finding.why))
    return opinions


def _agree(name: str, found: CheckResult, word: str | None, number: float | None) -> bool:
    """Return whether the plan's word and number of a verdict are those found, within its tolerance."""
    finding, tolerance = found.findings[name], VERDICT_TOLERANCES.get(name, 0.0)
    if finding.word == NOT_COVERED or word not in (YES, NO):
        return True
    if name == "holds" and found.moved:
        # Samples that near to their limits may fail in one view alone, and one more; 1e-9 covers rounding.
        tolerance = max(tolerance, (1 + found.borderline) / found.moved) + 1e-9
    if checker.is_later_part(found.file) and number is not None and finding.number is not None:
        worse = {"stable": finding.number - number, "within_wall": number - finding.number}
        if worse.get(name, 0.0) > 0:
            return True  # the plan counts the way to its first frame as well
    if word != finding.word:
        return finding.distance is not None and abs(finding.distance) <= tolerance
    if name not in VERDICT_TOLERANCES or number is None or finding.number is None or found.snaps:
        return True
    deep = name == "within_wall" and min(number, finding.number) > DEEP_MM
    # Of some of the samples the share may be another one; the record of each is compared.
    some = name == "holds" and found.moved < len(found.file.arrays.get("draws_parts", ()))
    return deep or some or abs(number - finding.number) <= tolerance
