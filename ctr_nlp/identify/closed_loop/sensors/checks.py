"""Checks of the arguments of all sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.support.value_checks import floats, number
from ctr_nlp.typing import Array


def check_positive(name: str, value: float, unit: str) -> None:
    """Raise OptionError unless `value` is finite and above 0; name, unit: of the number, for the message."""
    number(OptionError, name, value, lambda x: 0 < x < np.inf, "be a finite number > 0", unit)


def checked_places(sigma: Sequence[float]) -> Array:
    """Return sigma (n,), points on a robot, as an array; raise OptionError unless there are some in [0, 1]."""
    found = floats(OptionError, "sigma of a sensor", sigma, (None,))
    if not len(found) or found.min() < 0 or found.max() > 1:
        raise OptionError(f"sigma of a sensor is {sigma}; it must be one or more numbers in [0, 1]")
    return found
