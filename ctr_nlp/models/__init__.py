"""Models of the robot: configuration to backbone."""

from ctr_nlp.models import dominant

MODELS = {"dominant": dominant}
"""Every model by the name that options use."""
