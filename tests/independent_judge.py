"""The checker's verdicts on a plan, in the words of the library."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ctr_nlp.check.checker import NO as NO
from ctr_nlp.check.checker import NOT_COVERED, YES, CheckResult, Finding, examine_motion
from ctr_nlp.check.plan_file import read_plan_file

NOT_CHECKED = "NOT CHECKED"
VERDICTS = "solved", "arrives", "follows", "stable", "within_limits", "within_wall", "holds"


@dataclass(eq=False)
class Judgement:
    """Findings (word, number, distance from the threshold) by verdict, and the result that they are from."""

    findings: dict[str, tuple[str, float | None, float | None]]
    result: CheckResult

    @property
    def shape(self) -> np.ndarray:
        return self.result.shape

    @property
    def margin(self) -> np.ndarray:
        return self.result.margin


def judge(path: str | Path) -> Judgement:
    """Judge a saved plan, with all samples that the file has."""
    file = read_plan_file(path)
    found = examine_motion(file, len(file.arrays.get("draws_parts", ())))
    return Judgement({name: _in_words(found.findings[name]) for name in VERDICTS}, found)


def _in_words(finding: Finding) -> tuple[str, float | None, float | None]:
    word = NOT_CHECKED if finding.word == NOT_COVERED else finding.word
    assert word in (YES, NO, NOT_CHECKED)
    return word, finding.number, finding.distance
