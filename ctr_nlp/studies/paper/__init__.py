"""The paper's figures and its Table II remade from one run, beside what the paper printed."""

from ctr_nlp.studies.paper.parts import SECTIONS
from ctr_nlp.studies.paper.runs import PaperResults, run_tasks

__all__ = ["SECTIONS", "PaperResults", "run_tasks"]
