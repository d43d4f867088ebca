"""Live pictures of a running program, in windows with processes of their own."""

from ctr_nlp.view.figures.live.pictures import PlaybackPicture, PlaybackState, SolverPicture, SolverState
from ctr_nlp.view.figures.live.view import LiveWindow, Picture

__all__ = ["LiveWindow", "Picture", "PlaybackPicture", "PlaybackState", "SolverPicture", "SolverState"]
