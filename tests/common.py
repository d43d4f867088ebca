"""The named problems, and where the repository is."""

from pathlib import Path

from ctr_nlp import problems
from ctr_nlp.problems import named_problem

NAMES = list(problems.PROBLEM_NAMES)
ROOT = Path(__file__).resolve().parents[1]

__all__ = ["NAMES", "ROOT", "named_problem"]


UNJUDGED = (
    "--no-evaluate",
    *("--arrival-tolerance", "1000"),
    *("--error-allowed", "1000"),
    *("--contact-allowed", "1000"),
)
"""Options of commands in tests that are about something else than whether a plan is good."""
