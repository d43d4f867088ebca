"""What the cases of the study are to show, and where they do not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from ctr_nlp.studies.clearance.cases import WITH, Case

ROUNDING = 1e-6
"""% of e3 that rounding may add."""


@dataclass(frozen=True)
class Claim:
    """A sentence, the cases that it is about, and those among them that it does not hold for."""

    says: str
    about: tuple[Case, ...]
    exceptions: tuple[Case, ...]

    @property
    def holds(self) -> bool:
        """In every case that it is about."""
        return not self.exceptions

    def __str__(self) -> str:
        held = f"{len(self.about) - len(self.exceptions)} of {len(self.about)}"
        but = f"; not in {', '.join(case.name for case in self.exceptions)}" if self.exceptions else ""
        return f"{self.says}: in {held} cases{but}"


def claims(cases: Sequence[Case]) -> tuple[Claim, Claim, Claim]:
    """That clearance is cheap, that it helps, and that all of it is had where it can be had.

    The last is said the other way round: cases without any contact left are not asked what clearance alone
    could have.
    """
    most = 100 * WITH.clearance_cost
    return (
        _claim(
            f"with clearance e3 is at most {most:g} % above that without",
            cases,
            lambda case: case.growth <= most + ROUNDING,
        ),
        _claim(
            "summed contact depth is lower with clearance than without, where there is any without",
            [case for case in cases if case.contact_without > 0],
            lambda case: case.contact_with < case.contact_without,
        ),
        _claim(
            "where contact is left with clearance, clearance alone leaves some too",
            [case for case in cases if case.contact_with > 0],
            lambda case: not case.clearable,
        ),
    )


def _claim(says: str, about: Sequence[Case], holds: Callable[[Case], bool]) -> Claim:
    return Claim(says, tuple(about), tuple(case for case in about if not holds(case)))


def frames_missed(cases: Sequence[Case]) -> str:
    """The last claim frame by frame, as a sentence."""
    left = [case for case in cases if case.frames_with]
    missed, touching = (sum(getattr(case, name) for case in left) for name in ("alone_clear", "frames_with"))
    total = sum(case.frames for case in cases)
    some = sum(case.alone_clear > 0 for case in left)
    return (
        f"frame by frame: {touching} of {total} frames are in contact with clearance, in {len(left)} cases; "
        f"in {missed} of these, in {some} cases, clearance alone leaves no contact"
    )
