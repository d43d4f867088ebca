"""What a person states about a file of anatomy, and what a reader found out about it.

Files leave things open: a table has no unit, a VTK file no coordinate system, an image several labels.
`ReadOptions` are the answers of a person; `FileFacts` say what was read, what was assumed, and what was dropped or
repaired, so that nothing that was assumed looks as if the file had stated it.
"""

from __future__ import annotations

from dataclasses import dataclass

from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.value_checks import check_choice

MM_PER_UNIT = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "um": 0.001}
"""Units of length that a file may be in, and how many mm each is."""
SPACES = ("LPS", "RAS")
"""Patient coordinates that may be stated for a file that does not tell them."""
FORMS = ("qform", "sform")
"""Transforms of a NIfTI header, of which one may be chosen where they differ."""
ACCEPTABLE = ("leak", "ends", "steps")
"""Findings that are refused unless a person has looked at them: a path through a leak of the segmentation, entry
and target that seem exchanged, and steps between points that are much longer than their neighbours."""
WALLS_OF_MASKS = ("surface", "lumen")
"""What the wall of a mask may be: its surface, or a round lumen around the path."""

STATED, GIVEN, ASSUMED = "stated in the file", "given", "assumed"
"""How a unit or a coordinate system is known."""


@dataclass(frozen=True)
class ReadOptions:
    """Statements of a person about a file of anatomy; None and empty tuples leave the matter to the file.

    Attributes
    ----------
    units : str or None
        Unit of the file's lengths, one of MM_PER_UNIT.
    space : str or None
        Patient coordinates of the file, one of SPACES.
    labels : tuple of int
        Labels of a mask that are the lumen.
    segment : str or None
        Name of the segment of a segmentation that is the lumen.
    threshold : float or None
        Value from which a voxel of a probability map belongs to the lumen.
    form : str or None
        Which transform of a NIfTI header counts, one of FORMS.
    accept : tuple of str
        Findings that the person has looked at, of ACCEPTABLE.

    Raises
    ------
    OptionError
        A value is not one of those allowed.
    """

    units: str | None = None
    space: str | None = None
    labels: tuple[int, ...] = ()
    segment: str | None = None
    threshold: float | None = None
    form: str | None = None
    accept: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, allowed in (("units", tuple(MM_PER_UNIT)), ("space", SPACES), ("form", FORMS)):
            value = getattr(self, name)
            if value is not None:
                check_choice(name, value, allowed)
        for finding in self.accept:
            check_choice("accept", finding, ACCEPTABLE)
        for label in self.labels:
            if not isinstance(label, int) or isinstance(label, bool):
                raise OptionError(f"label is {label!r}; labels of a mask are whole numbers")


@dataclass(frozen=True)
class FileFacts:
    """Findings of a reader about a file of anatomy, for `ctr-nlp inspect` and for the notes of a plan.

    Attributes
    ----------
    kind : str
        Kind of file in the words of its users, as "markups of 3D Slicer".
    units : str
        Unit of its lengths, one of MM_PER_UNIT.
    units_known : str
        How the unit is known: STATED, GIVEN or ASSUMED.
    space_known : str
        How the coordinate system is known: STATED, GIVEN or ASSUMED.
    notes : tuple of str
        What was dropped, repaired or assumed, and what deserves a look; a sentence each.
    """

    kind: str = ""
    units: str = "mm"
    units_known: str = ASSUMED
    space_known: str = ASSUMED
    notes: tuple[str, ...] = ()


AS_THE_FILE_SAYS = ReadOptions()
"""Options where a person states nothing."""
NO_FACTS = FileFacts()
"""Facts of branches that no reader made."""
