"""How plans of many airways survive robots that are not quite known: plain, at several margins, and robust."""

from ctr_nlp.studies.survival.cases import Airway, study

__all__ = ["Airway", "study"]
