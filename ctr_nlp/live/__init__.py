"""Live steering: a session, moved step by step, and a scene in the browser that shows it. Knows no command line."""

from ctr_nlp.live.live import Live
from ctr_nlp.live.session import Session

__all__ = ["Live", "Session"]
