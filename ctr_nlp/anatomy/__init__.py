"""Lumens to curves: a seeded generator of airways."""

from ctr_nlp.anatomy.airway import synthetic_airway

__all__ = ["synthetic_airway"]
