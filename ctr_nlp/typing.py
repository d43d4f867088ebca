"""Types that rooms share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int_]
Flags = npt.NDArray[np.bool_]
Vector = tuple[Any, Any, Any]
"""x, y and z: numbers, arrays or symbols."""
Field = Callable[[Array], Array]
"""A function of places (n,)."""
