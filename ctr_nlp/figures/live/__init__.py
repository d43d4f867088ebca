"""Pictures of work that goes on, in windows with processes of their own."""

from ctr_nlp.figures.live.pictures import Now, Playing, Solving, Stage
from ctr_nlp.figures.live.view import Picture, View

__all__ = ["Now", "Picture", "Playing", "Solving", "Stage", "View"]
