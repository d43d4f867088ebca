"""The elastic model: how tubes twist each other, the shape that this gives, and whether it is stable."""

from ctr_nlp.models.elastic.model import Elastic

__all__ = ["Elastic"]
