"""Nitinol tubing that can be bought: tables of it, and the combinations that come nearest to designed tubes."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.shared.design import DesignedTubes
from ctr_nlp.robot.tube import TUBE_DIAMETER_RANGE_MM
from ctr_nlp.typing import Array

STOCK_TABLE_PATH = Path(__file__).with_name("stock.csv")
"""The package's own table."""
INCH = 25.4
"""An inch in mm."""
DIAMETER_COLUMNS = "outer_diameter", "inner_diameter"
"""The two diameters, as columns of a table and entries of p are called."""
BEAM_WIDTH = 400
"""Width of the beam search: unfinished combinations that are kept from tube to tube."""
EXCESS_STRAIN_WEIGHT = 4.0
"""Weight of a tube that is too thick for its curvature, against one whose stiffness is off by the same ratio."""
NESTING_TOLERANCE_MM = 1e-9
"""Error in mm by which sums of decimal numbers may miss a rule."""


class StockTube(NamedTuple):
    """Tubing as it is sold.

    Attributes
    ----------
    part : str
        Name of the part.
    outer, inner : float
        Diameters, mm.
    source : str
        Publication or list that states them.
    """

    part: str
    outer: float
    inner: float
    source: str

    @property
    def section(self) -> float:
        """Second moment of area of the cross-section, mm^4."""
        return math.pi / 64 * (self.outer**4 - self.inner**4)


def read_stock(path: str | Path | None = None) -> tuple[StockTube, ...]:
    """Read tubing that can be bought from a CSV file.

    The file has the columns ``part``, ``outer_diameter_mm`` and ``inner_diameter_mm``, or the diameters in inches
    as ``outer_diameter_in`` and ``inner_diameter_in``. A column ``source`` is stored, all others are ignored, and
    so are lines that begin with ``#``.

    Parameters
    ----------
    path : str or Path, optional
        The file; by default the table of this package, of tubes of published robots.

    Returns
    -------
    tuple of StockTube
        In the order of the file.

    Raises
    ------
    OptionError
        The file cannot be read, lacks a column, or has a diameter that no tube has; the message names the line and
        the column.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> stock = ctr.read_stock()
    >>> stock[0].part, stock[0].outer, stock[0].inner
    ('Table I tube 1', 5.7, 4.3)
    """
    place = STOCK_TABLE_PATH if path is None else Path(path)
    try:
        with open(place, newline="", encoding="utf-8-sig") as file:
            lines = [(number, line) for number, line in enumerate(file, 1) if line.strip() and line[0] != "#"]
        rows = list(csv.DictReader(line for _, line in lines))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise OptionError(f"the stock {place} cannot be read: {error}") from error
    names = set(rows[0]) if rows else set()
    unit = next((unit for unit in ("mm", "in") if {f"{end}_{unit}" for end in DIAMETER_COLUMNS} <= names), None)
    if unit is None or "part" not in names:
        raise OptionError(
            f"the stock {place} must have rows, and columns part, outer_diameter_mm and inner_diameter_mm (or _in "
            f"for inches); it has {', '.join(map(str, sorted(names, key=str))) or 'no rows'}"
        )
    return tuple(_tube(place, number, row, unit) for (number, _), row in zip(lines[1:], rows, strict=True))


def _tube(place: Path, line: int, row: dict[str, str | None], unit: str) -> StockTube:
    """Return the tubing of one line of a stock file, whose diameters are in `unit`, ``"mm"`` or ``"in"``."""
    found = []
    for end in DIAMETER_COLUMNS:
        name = f"{end}_{unit}"
        text = row[f"{end}_{unit}"]
        try:
            value = float(text or "") * (INCH if unit == "in" else 1.0)
        except ValueError:
            value = math.nan
        if not TUBE_DIAMETER_RANGE_MM[0] <= value <= TUBE_DIAMETER_RANGE_MM[1]:
            raise OptionError(
                f"line {line} of the stock {place}: {name} is {text!r}; it must be a number between "
                f"{TUBE_DIAMETER_RANGE_MM[0]:g} and {TUBE_DIAMETER_RANGE_MM[1]:g} mm"
            )
        found.append(round(value, 6))
    outer, inner = found
    if inner >= outer:
        raise OptionError(
            f"line {line} of the stock {place}: inner_diameter_{unit} is {row[f'inner_diameter_{unit}']!r}; it "
            f"must be less than outer_diameter_{unit}, which is {row[f'outer_diameter_{unit}']!r}"
        )
    return StockTube(row["part"] or f"line {line}", outer, inner, row.get("source") or str(place))


def nearest_stock(
    stock: Sequence[StockTube], tubes: DesignedTubes, p: Array, loaded: bool = False
) -> list[tuple[StockTube, ...]]:
    """Find the combinations of stock that nest and come nearest to designed tubes.

    Without a load, shapes depend on the ratios of stiffnesses alone. The distance is therefore the sum over
    neighbours of (change of log(EI_i / EI_{i+1}))^2; with a load, that of the innermost tube, (change of log
    EI_d)^2, is added. A tube that is too thick for its curvature costs the square of the logarithm of its excess
    strain, times EXCESS_STRAIN_WEIGHT^2.

    Parameters
    ----------
    stock : sequence of StockTube
        Tubing that can be bought.
    tubes : DesignedTubes
        The tubes as unknowns, with rules. A tube with a fixed diameter stays as it is.
    p : ndarray
        Unknowns (P,) of the designed tubes.
    loaded : bool
        Whether a load acts on the robots, or may.

    Returns
    -------
    list of tuple of StockTube
        Combinations, outermost tube first, the nearest one first; found by a beam search.

    Raises
    ------
    OptionError
        No tubes of the stock nest within the rules.
    """
    robot = tubes.robot_of(p)
    rules = tubes.rules
    moduli = [tube.youngs_modulus for tube in robot.tubes]
    wanted = [math.log(tube.bending_stiffness) for tube in robot.tubes]
    found: list[tuple[float, tuple[StockTube, ...]]] = [(0.0, ())]
    # From the innermost tube outwards: each must clear the one inside it, and ratios need the stiffness of that
    # one.
    for i in reversed(range(robot.d)):
        tube = robot.tubes[i]
        longer = list[tuple[float, tuple[StockTube, ...]]]()
        for cost, inside in found:
            least = inside[0].outer + rules.clearance if inside else rules.channel
            for one in _choices(stock, tubes, p, i):
                wall = (one.outer - one.inner) / 2
                if min(one.inner - least, wall - rules.wall, rules.outer - one.outer) < -NESTING_TOLERANCE_MM:
                    continue
                # Part of the allowed strain that the tubing would have at the designed curvature; above 1 it must
                # be made straighter.
                bent = tube.largest_curvature * one.outer / 2 / rules.strain_made
                more = (EXCESS_STRAIN_WEIGHT * math.log(bent)) ** 2 if bent > 1 else 0.0
                stiffer = math.log(moduli[i] * one.section) - wanted[i]
                if inside:
                    more += (stiffer - math.log(moduli[i + 1] * inside[0].section) + wanted[i + 1]) ** 2
                elif loaded:
                    more += stiffer**2
                longer.append((cost + more, (one, *inside)))
        # Beam search: combinations whose inner tubes cost more than BEAM_WIDTH others are given up, though outer
        # ones might make up for it.
        found = sorted(longer, key=lambda state: state[0])[:BEAM_WIDTH]
    if not found:
        raise OptionError(
            f"no {robot.d} tubes of the stock nest with walls of at least {rules.wall:g} mm, {rules.clearance:g} "
            f"mm between diameters, an inner channel of {rules.channel:g} mm and at most {rules.outer:g} mm "
            "outside; ease these rules or give another list"
        )
    return [inside for _, inside in found]


def _choices(stock: Sequence[StockTube], tubes: DesignedTubes, p: Array, i: int) -> Sequence[StockTube]:
    """Return the tubing to choose from for tube i, from 0: the stock, or the tube itself where a diameter is
    fixed.
    """
    names = [f"{end}_{i + 1}" for end in DIAMETER_COLUMNS]
    if not any(name in tubes.fixed for name in names):
        return stock
    outer, inner = (float(p[tubes.names.index(name)]) for name in names)
    return (StockTube("as it was fixed", outer, inner, "the robot"),)


def with_diameters(tubes: DesignedTubes, p: Array, chosen: Sequence[StockTube]) -> Array:
    """Return the unknowns with the diameters of chosen tubes, and curvatures that these can be bent to.

    Parameters
    ----------
    tubes : DesignedTubes
        The tubes as unknowns.
    p : ndarray
        Unknowns (P,).
    chosen : sequence of StockTube
        Tubing for the d tubes, outermost first.

    Returns
    -------
    ndarray
        Changed unknowns (P,).
    """
    found = np.array(p, dtype=float)
    names = tubes.names
    for k, name in enumerate(names):
        kind, _, number = name.rpartition("_")
        one = chosen[int(number) - 1]
        if kind in DIAMETER_COLUMNS:
            found[k] = one.outer if kind == "outer_diameter" else one.inner
        elif kind.endswith("curvature") and name not in tubes.fixed:
            # The strain k D / 2 at the outer fibre, solved for k, in 1/(100 mm).
            found[k] = min(found[k], 100.0 * 2 * tubes.rules.strain_made / one.outer)
    return found
