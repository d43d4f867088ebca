"""Anatomy: readers of centrelines and masks, and a seeded generator of synthetic airways."""

from ctr_nlp.anatomy.airway import synthetic_airway

__all__ = ["synthetic_airway"]
