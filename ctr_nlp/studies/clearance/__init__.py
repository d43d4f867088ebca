"""What clearance costs and brings: plans without and with it, over many airways."""

from ctr_nlp.studies.clearance.cases import Case, Source, study

__all__ = ["Case", "Source", "study"]
