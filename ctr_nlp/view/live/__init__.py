"""Live steering: a robot that is moved step by step, and a page that shows it. Knows no command line."""

from ctr_nlp.view.live.live import Live
from ctr_nlp.view.live.steered.session import Session

__all__ = ["Live", "Session"]
