"""The named problems, and where the repository is."""

from pathlib import Path

from ctr_nlp import problems
from ctr_nlp.problems import named

NAMES = list(problems.NAMES)
ROOT = Path(__file__).resolve().parents[1]

__all__ = ["NAMES", "ROOT", "named"]
