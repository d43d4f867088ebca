"""The errors this library raises on bad input; each names the field, its value and what is allowed."""

import difflib
import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

MAX_MESSAGE_LENGTH, LEFT_OUT = 2500, " [...] "
"""Letters of a message, and what stands for those in the middle of a longer one, such as a key of thousands."""
MAX_SUGGESTIONS, MIN_SUGGESTION_SIMILARITY = 2, 0.7
"""Words that a message offers at most, and how alike they must be to what was given (difflib)."""


def escape_control_characters(text: str) -> str:
    r"""Escape what a terminal, a page or a reader would obey instead of showing it.

    Parameters
    ----------
    text : str
        From a file, a plan or a person, such as the name of a problem.

    Returns
    -------
    str
        One line: control characters, line breaks, marks that turn the direction of writing, and what is no
        character at all stand as Python writes them.

    Examples
    --------
    >>> print(escape_control_characters("left [lung]\x1b[2J\n"))
    left [lung]\x1b[2J\n
    """
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


class CtrError(Exception):
    """Base of every error that ctr_nlp raises itself. Its message is one line, whatever it quotes from a file."""

    def __str__(self) -> str:
        said = escape_control_characters(super().__str__())
        if len(said) <= MAX_MESSAGE_LENGTH:
            return said
        # what is wrong stands at the beginning, and what is allowed at the end; in between is what a file holds
        half = (MAX_MESSAGE_LENGTH - len(LEFT_OUT)) // 2
        return f"{said[:half]}{LEFT_OUT}{said[-half:]}"


class RobotError(CtrError):
    """Tubes or limits that no robot can have, or a robot file that cannot be read."""


class LoadError(CtrError):
    """A load that no robot bears, or a robot that does not tell how stiff it is in MPa."""


class CurveError(CtrError):
    """Points, formulas or files that do not describe a centreline."""


class ProblemError(CtrError):
    """A robot and a target that do not go together."""


class OptionError(CtrError):
    """An unknown name, or an option out of its range; the message lists the valid ones."""


class OutputError(CtrError):
    """A place that cannot be written, or a plan that cannot be read."""


class ClusterError(CtrError):
    """A Dask cluster that cannot be reached, was lost, or cannot do what a study asks for."""


class MeasurementError(CtrError):
    """Measurements that cannot be read, or that no robot of this kind can have given."""


class BenchmarkError(CtrError):
    """A row that cannot be timed, or a commit that cannot be checked out to be compared."""


class TrajectoryError(CtrError):
    """A plan that this hardware cannot or must not play; the message names frame and axis."""


class HardwareError(CtrError):
    """A hardware file that cannot be read, or describes what no rig can be."""


class DeviceFault(CtrError):
    """A device that does not do what it should: the message says what was seen."""


class Stopped(DeviceFault):
    """A stop that was asked for while a device was being connected, carried out; result: how that ended."""

    def __init__(self, result: Any) -> None:
        super().__init__(result.message)
        self.result = result


class JournalError(CtrError):
    """A journal that cannot be written, or cannot be read back."""


def find_near_names(given: object, allowed: Iterable[str]) -> list[str]:
    """The names in `allowed` that are nearly what was given, the nearest first; none where nothing is."""
    bare = {word.lstrip("-"): word for word in allowed}  # dashes would make all options alike
    near = difflib.get_close_matches(str(given).lstrip("-"), bare, MAX_SUGGESTIONS, MIN_SUGGESTION_SIMILARITY)
    return [bare[word] for word in near]


def suggest_names(given: object, allowed: Iterable[str]) -> str:
    """A sentence for the end of a message: what of that allowed is nearly what was given; "" where nothing is."""
    near = find_near_names(given, allowed)
    return f". Did you mean {' or '.join(map(repr, near))}?" if near else ""


if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Names of before, for one more version."""
        if name == "ProgramError":
            warnings.warn("ProgramError is called TrajectoryError now", DeprecationWarning, stacklevel=2)
            return TrajectoryError
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
