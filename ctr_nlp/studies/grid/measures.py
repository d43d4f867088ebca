"""What a study may measure of plans beside their summaries."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from ctr_nlp.plan.plan import Plan
from ctr_nlp.studies.clearance.cases import contact, contact_alone
from ctr_nlp.target.problem import Problem

MEASURES: Mapping[str, Callable[[Plan, Problem], dict[str, float]]] = {
    "contact": contact,
    "contact alone": contact_alone,
}
"""Columns of a plan's row, by the name of what is measured."""
