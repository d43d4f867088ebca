"""Plans to pictures: what the paper shows in its Figs. 4, 5, 6 and 8, for any plan."""

from ctr_nlp.figures.clearance import clearance
from ctr_nlp.figures.files import save, save_all
from ctr_nlp.figures.film import check_film, film
from ctr_nlp.figures.frames import by_frame
from ctr_nlp.figures.motion import configuration
from ctr_nlp.figures.overlay import shapes
from ctr_nlp.figures.stability import stability
from ctr_nlp.figures.tracking import tracking
from ctr_nlp.figures.violins import errors

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
