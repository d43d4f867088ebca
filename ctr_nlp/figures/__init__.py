"""Plans to pictures: what the paper shows in its Figs. 4, 5, 6 and 8, for any plan."""

from ctr_nlp.figures.errors import by_frame, errors
from ctr_nlp.figures.files import save, save_all
from ctr_nlp.figures.film import check_film, film
from ctr_nlp.figures.margins import clearance, stability
from ctr_nlp.figures.motion import configuration
from ctr_nlp.figures.overlay import shapes
from ctr_nlp.figures.tracking import tracking

__all__ = [
    "by_frame",
    "check_film",
    "clearance",
    "configuration",
    "errors",
    "film",
    "save",
    "save_all",
    "shapes",
    "stability",
    "tracking",
]
