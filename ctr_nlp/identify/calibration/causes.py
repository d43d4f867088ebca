"""Causes of measurements that contradict a robot: mistakes in a file without which the robot would fit it.

A cause is a usual mistake together with the measurements without it: lengths in another unit, angles in degrees,
an exchanged sign, mirrored or exchanged axes, points or rows in another order. All causes are compared cheaply, by
the predictions of a given robot and, where the base's pose is unknown, the rigid motion that registers them to the
measurements. The few that fit better are fitted, and one is confirmed only if its fit is many times better.

Residuals are compared as parts of the size of what was measured: measurements in metres that are taken for mm are
a thousand times smaller, and so are their residuals.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from ctr_nlp.identify.calibration.measurements import EXTENSION_TOLERANCE_MM, Measurements
from ctr_nlp.identify.calibration.prediction import Prediction, register_points
from ctr_nlp.robot import Robot
from ctr_nlp.typing import Array, Index

LENGTH_UNITS = {"cm": 10.0, "in": 25.4, "m": 1000.0, "um": 0.001}
"""Units that lengths may be in by mistake, and how many mm each is."""
MAX_ROW_SHIFT = 5
"""Largest number of rows by which points may be shifted against configurations."""
MAX_COMPARED_ROWS = 200
"""Largest number of observations that causes are compared on: the first ones, with all of their neighbours."""
LEAST_REGISTERED_POINTS = 3
"""Least number of points that determine a rotation."""
MAX_MATCHING_STEPS = 30
"""Largest number of alternations between a matching and a registration."""
RANDOM_MATCHING_STARTS = 12
"""Number of random rotations that rows of unknown order and base are matched from, beside the principal axes."""
LARGE_MISMATCH_MM = 1e4
"""Distance that stands for that of a robot without an equilibrium, mm."""
MAX_NAMED_LINES = 8
"""Largest number of lines that a message names."""


@dataclass(frozen=True, eq=False)
class Cause:
    """A mistake in a file of measurements, and what would have been measured without it.

    Attributes
    ----------
    words : str
        Ends the sentence "They fit 20 times better if ..". Empty where nothing in the file is changed.
    measured : Measurements
        The measurements without the mistake.
    scale : float
        By how much lengths of what was measured are larger without it.
    free_order : bool
        Whether an order of rows or points was chosen that fits best: chance then makes residuals smaller, too.
    has_base : bool
        Whether a pose of the base is among what is changed.
    """

    words: str
    measured: Measurements
    scale: float = 1.0
    free_order: bool = False
    has_base: bool = False


@dataclass(frozen=True, eq=False)
class CauseSearch:
    """Measurements, robot and prediction among which the cause of a contradiction is searched.

    Attributes
    ----------
    robot : Robot
        The robot, which bounds configurations.
    measured : Measurements
        The T observations.
    prediction : Prediction
        Predictions that have no base among their parameters.
    values : (P,) array
        Values of its parameters.
    registered : bool
        Whether the sensor's axes are those of the base.
    """

    robot: Robot
    measured: Measurements
    prediction: Prediction
    values: Array
    registered: bool

    def predict_places(self, measured: Measurements) -> Array:
        """Predict the tip and the points (T, 1 + n, 3) of some observations in the base's axes, mm."""
        seen = self.prediction.with_measurements(measured).predict_values(self.values)
        return np.concatenate([seen.tip[:, None], seen.points], axis=1)

    def mismatch(self, cause: Cause, predicted: Array | None = None) -> float:
        """Compute the mean distance of measured places from predicted ones, over the scale of a cause.

        Parameters
        ----------
        cause : Cause
            The cause, whose measurements are compared.
        predicted : (T, 1 + n, 3) array, optional
            Places that are predicted for them, if that has been done, mm.

        Returns
        -------
        float
            In units of the measurements as they were given.
        """
        found = self.predict_places(cause.measured) if predicted is None else predicted
        registered = self.registered and not cause.has_base
        distances = place_distances(register(found, cause.measured, registered), places_of(cause.measured))
        return float(np.nanmean(distances)) / cause.scale if np.isfinite(distances).any() else math.inf


def places_of(measured: Measurements) -> Array:
    """Return the measured tips and points (T, 1 + n, 3), mm."""
    return np.concatenate([measured.tip[:, None], measured.points], axis=1)


def place_distances(predicted: Array, places: Array) -> Array:
    """Return distances (T, n) of predicted from measured places (T, n, 3), mm; NaN where none was measured."""
    known = np.isfinite(places).any(axis=2)
    apart = np.sqrt(np.nansum((places - predicted) ** 2, axis=2))
    # A sum over NaN alone is 0: where the robot has no equilibrium, nothing is predicted, and nothing explained.
    apart = np.where(np.isfinite(predicted).all(axis=2), apart, LARGE_MISMATCH_MM)
    return np.where(known, apart, np.nan)


def register(predicted: Array, measured: Measurements, registered: bool) -> Array:
    """Return predicted places (T, n, 3) in the sensor's axes, each recording registered; mm.

    registered: whether the sensor's axes are the base's, so that nothing is to be done.
    """
    if registered:
        return predicted
    places = places_of(measured)
    found = np.array(predicted)
    for recording in range(measured.recordings):
        own = measured.recording == recording
        turn, place = register_points(predicted[own].reshape(-1, 3), places[own].reshape(-1, 3))
        found[own] = predicted[own] @ turn.T + place
    return found


def compare_causes(search: CauseSearch, with_rows: bool, timed: bool) -> list[tuple[float, Cause]]:
    """Compute how well all causes fit.

    Parameters
    ----------
    search : CauseSearch
        Robot, measurements and predictions.
    with_rows : bool
        Whether any order of rows is tried, which takes longest.
    timed : bool
        Whether this is a motion, whose rows are in the order of time.

    Returns
    -------
    list of (float, Cause)
        Mismatch of each cause, the best one first.
    """
    found = list[tuple[float, Cause]]()
    for changed in _configuration_causes(search):
        predicted = search.predict_places(changed.measured)
        for cause in (changed, *_unit_causes(search, changed)):
            found.append((search.mismatch(cause, predicted), cause))
    predicted = search.predict_places(search.measured)
    none = Cause("", search.measured)
    for cause in (*_unit_causes(search, none), *_axis_causes(search), *_base_causes(search)):
        found.append((search.mismatch(cause, predicted), cause))
    for cause in (*_position_causes(search), *_point_order_causes(search, predicted)):
        found.append((search.mismatch(cause), cause))
    if not timed:
        found += [(search.mismatch(cause), cause) for cause in _shift_causes(search)]
    if with_rows and not timed:
        found += [(search.mismatch(cause), cause) for cause in _row_order_causes(search, predicted)]
    return sorted(found, key=lambda pair: pair[0])


def _named_columns(search: CauseSearch, kind: str) -> str:
    """Return the names of all columns of a kind, alpha or beta, for a sentence."""
    d = search.robot.d
    return f"{kind}_1" if d == 1 else f"{kind}_1 to {kind}_{d}"


def _measured_words(measured: Measurements) -> str:
    """Return what was measured, for a sentence."""
    has_points = np.isfinite(measured.points).any()
    if np.isfinite(measured.tip).any():
        return "tip and points" if has_points else "tip_x, tip_y and tip_z"
    return "points"


def _configuration_causes(search: CauseSearch) -> Iterator[Cause]:
    """Yield causes that change configurations, and that leave them possible."""
    measured = search.measured
    robot = search.robot
    d = robot.d
    alphas, betas = _named_columns(search, "alpha"), _named_columns(search, "beta")

    def changed(words: str, change: Callable[[Array], None]) -> Iterator[Cause]:
        q = np.array(measured.q)
        change(q)
        if not (q == measured.q).all() and _is_possible(robot, q):
            yield Cause(words, replace(measured, q=q))

    def scale(columns: slice, factor: float) -> Callable[[Array], None]:
        def apply(q: Array) -> None:
            q[:, columns] *= factor

        return apply

    for unit, factor in LENGTH_UNITS.items():
        yield from changed(f"{betas} are in {unit}", scale(slice(d, 2 * d), factor))
    yield from changed(f"{alphas} are in degrees", scale(slice(0, d), math.pi / 180))
    for count in range(1, d + 1):
        for tubes in itertools.combinations(range(d), count):
            names = "all alphas" if count == d > 1 else " and ".join(f"alpha_{i + 1}" for i in tubes)
            have = "has" if count == 1 else "have"

            def turn(q: Array, tubes: tuple[int, ...] = tubes) -> None:
                q[:, tubes] *= -1

            yield from changed(f"{names} {have} the opposite sign", turn)
    for i, j in itertools.combinations(range(d), 2):

        def exchange(q: Array, i: int = i, j: int = j) -> None:
            q[:, [i, j]] = q[:, [j, i]]

        yield from changed(f"the columns alpha_{i + 1} and alpha_{j + 1} are exchanged", exchange)
    if d > 2:
        for order in itertools.permutations(range(d)):
            if sum(k != place for place, k in enumerate(order)) == d:

                def permute(q: Array, order: tuple[int, ...] = order) -> None:
                    q[:, :d] = q[:, order]

                names = ", ".join(f"alpha_{k + 1}" for k in order)
                yield from changed(f"the columns {alphas} are in the order {names}", permute)

    def accumulate(q: Array) -> None:
        q[:, :d] = np.cumsum(q[:, :d], axis=1)

    yield from changed("each alpha is the angle from the tube around it, and not from the base", accumulate)

    def accumulate_from_inside(q: Array) -> None:
        q[:, :d] = np.cumsum(q[:, :d][:, ::-1], axis=1)[:, ::-1]

    yield from changed(
        "each alpha is the angle from the tube inside it, and not from the base", accumulate_from_inside
    )

    def extend(q: Array) -> None:
        q[:, d : 2 * d] = np.cumsum(q[:, d : 2 * d], axis=1)

    yield from changed("each beta is how far a tube comes out of the one around it", extend)


def _is_possible(robot: Robot, q: Array) -> bool:
    """Return whether the extensions of all q (T, 2d + 2) are in order and within the tubes' lengths."""
    beta = robot.split(q)[1]
    lengths = np.array([tube.length for tube in robot.tubes])
    steps = np.diff(beta, axis=1, prepend=0.0)
    in_order = (steps >= -EXTENSION_TOLERANCE_MM).all() and (beta <= lengths + EXTENSION_TOLERANCE_MM).all()
    return bool(in_order and (beta[:, -1] > 0).all())


def _unit_causes(search: CauseSearch, changed: Cause) -> Iterator[Cause]:
    """Yield causes with measured places in another unit, after what `changed` has changed."""
    what = _measured_words(search.measured)
    # Of changed configurations only their own unit goes together with that of the places.
    units = (
        {unit: by for unit, by in LENGTH_UNITS.items() if changed.words.endswith(f"are in {unit}")}
        if changed.words
        else LENGTH_UNITS
    )
    for unit, factor in units.items():
        measured = replace(
            changed.measured, tip=changed.measured.tip * factor, points=changed.measured.points * factor
        )
        words = f"{what} are in {unit}"
        if changed.words:
            words = f"{changed.words.removesuffix(f' are in {unit}')} and {words}"
        yield Cause(words, measured, factor)


def _axis_causes(search: CauseSearch) -> Iterator[Cause]:
    """Yield causes with mirrored or exchanged axes of what was measured."""
    measured = search.measured
    if not search.registered:
        # A rotation of the sensor's axes is part of its unknown pose, so that only handedness shows.
        yield _turn_measurements(
            measured, np.diag([1.0, 1.0, -1.0]), "one axis of the sensor is mirrored, or two are exchanged"
        )
        return
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[range(3), order] = signs
            if (matrix == np.eye(3)).all():
                continue
            yield _turn_measurements(measured, matrix, _axis_words(order, signs))


def _axis_words(order: tuple[int, ...], signs: tuple[float, ...]) -> str:
    """Return what axes are by a signed permutation, for a sentence: row k has the sign in column order[k]."""
    minus = [name for name, sign in zip("xyz", signs, strict=True) if sign < 0]
    moved = [k for k in range(3) if order[k] != k]
    if not moved:
        have = "has" if len(minus) == 1 else "have"
        return f"{' and '.join(minus)} of what was measured {have} the opposite sign"
    if len(moved) == 2 and not minus:
        first, second = ("xyz"[k] for k in moved)
        return f"{first} and {second} of what was measured are exchanged"
    names = ", ".join(f"{'-' if sign < 0 else ''}{'xyz'[k]}" for k, sign in zip(order, signs, strict=True))
    return f"x, y, z of the robot are {names} of what was measured"


def _turn_measurements(measured: Measurements, matrix: Array, words: str) -> Cause:
    """Return a cause in which measured vectors are multiplied by a matrix (3, 3)."""
    tip, direction, points = (
        _multiply(vectors, matrix) for vectors in (measured.tip, measured.direction, measured.points)
    )
    return Cause(words, replace(measured, tip=tip, direction=direction, points=points))


def _multiply(vectors: Array, matrix: Array) -> Array:
    """Return vectors (.., 3) times a signed permutation (3, 3); a coordinate that is NaN makes no other one so."""
    order = abs(matrix).argmax(axis=1)
    return np.asarray(vectors[..., order] * matrix[range(3), order])


def _base_causes(search: CauseSearch) -> Iterator[Cause]:
    """Yield the cause that the base's pose is unknown, where it was said to be known."""
    if search.registered:
        yield Cause("", search.measured, has_base=True)
        mirrored = _turn_measurements(search.measured, np.diag([1.0, 1.0, -1.0]), "")
        words = "the base has a pose in the sensor's axes, and one axis of the sensor is mirrored"
        yield replace(mirrored, words=words, has_base=True)


def _position_causes(search: CauseSearch) -> Iterator[Cause]:
    """Yield causes that change where points are on the robot."""
    sigma = search.measured.sigma
    for unit, factor in LENGTH_UNITS.items():
        if np.isfinite(sigma).any() and factor > 1 and np.nanmax(sigma) * factor <= 1 + 1e-9:
            yield Cause(f"p1_s .. are in {unit}", replace(search.measured, sigma=sigma * factor))
    if sigma.shape[1] > 1:
        yield Cause("arc lengths of points are counted from the tip", replace(search.measured, sigma=1 - sigma))


def _shift_causes(search: CauseSearch) -> Iterator[Cause]:
    """Yield causes in which rows of points are shifted against rows of configurations, or reversed."""
    measured = search.measured
    if len(measured) < 3:
        return
    count = len(measured)
    rows = np.arange(count)
    sizes = np.bincount(measured.recording)
    for shift in (k for k in range(-MAX_ROW_SHIFT, MAX_ROW_SHIFT + 1) if k and abs(k) <= count // 3):
        kept = rows[(rows + shift >= 0) & (rows + shift < count)]
        kept = kept[measured.recording[kept] == measured.recording[kept + shift]]
        if len(kept) > 1:
            where = f"{abs(shift)} row{'s' if abs(shift) > 1 else ''} {'below' if shift > 0 else 'above'}"
            words = f"what was measured stands {where} its configuration"
            yield Cause(words, repair_rows(measured, kept, kept + shift))
        if len(kept) > 1 and len(sizes) == 1:
            yield Cause(f"{words}, around the end", repair_rows(measured, rows, (rows + shift) % count))
    backwards = np.concatenate([np.flatnonzero(measured.recording == k)[::-1] for k in range(len(sizes))])
    yield Cause(
        "what was measured is in the reverse order of the configurations", repair_rows(measured, rows, backwards)
    )


def repair_rows(measured: Measurements, configurations: Index, seen: Index) -> Measurements:
    """Return the configurations of some rows (n,) with what was measured in other rows (n,).

    Positions of points on the robot stay with the points.
    """
    other = measured[seen]
    there = measured[configurations]
    return replace(there, tip=other.tip, direction=other.direction, points=other.points, sigma=other.sigma)


def _point_order_causes(search: CauseSearch, predicted: Array) -> Iterator[Cause]:
    """Yield causes in which points stand in another order, in all rows alike or in each row in its own.

    predicted: (T, 1 + n, 3), places in the base's axes, mm.
    """
    measured = search.measured
    count = measured.sigma.shape[1]
    if count < 2:
        return
    costs = _point_costs(search, predicted)
    order = linear_sum_assignment(costs.mean(axis=0))[1]
    if (order != np.arange(count)).any():
        names = ", ".join(f"p{k + 1}" for k in order)
        yield Cause(
            f"p1 to p{count} are in the order {names}", replace(measured, points=measured.points[:, order])
        )
    orders = np.array([linear_sum_assignment(cost)[1] for cost in costs])
    changed = np.flatnonzero((orders != np.arange(count)).any(axis=1))
    if len(changed) and (orders != orders[0]).any():
        points = np.take_along_axis(measured.points, orders[:, :, None], axis=1)
        words = f"points are in another order in {name_lines(measured, changed)}"
        yield Cause(words, replace(measured, points=points), free_order=True)


def _point_costs(search: CauseSearch, predicted: Array) -> Array:
    """Return squared distances (T, n, n) of predicted points (rows) from measured ones (columns).

    predicted: (T, 1 + n, 3), tips and points in the base's axes, mm.
    """
    measured = search.measured
    places = places_of(measured)
    costs = np.zeros((*measured.sigma.shape, measured.sigma.shape[1]))
    for recording in range(measured.recordings):
        rows = measured.recording == recording
        turn, place = np.eye(3), np.zeros(3)
        if not search.registered:
            turn, place = _register_in_any_order(predicted[rows], places[rows])
        costs[rows] = _squared_distances(predicted[rows, 1:] @ turn.T + place, places[rows, 1:])
    return costs


def _register_in_any_order(predicted: Array, places: Array) -> tuple[Array, Array]:
    """Return rotation and translation between rows of a tip and of points (T, 1 + n, 3) in unknown orders, mm."""
    complete = np.isfinite(places).all(axis=(1, 2))
    if complete.sum() < LEAST_REGISTERED_POINTS:
        turn, place = register_points(predicted.reshape(-1, 3), places.reshape(-1, 3))
    else:
        # The mean of a row's points does not depend on their order.
        turn, place = register_points(
            np.vstack([predicted[complete, 1:].mean(axis=1), predicted[:, 0]]),
            np.vstack([places[complete, 1:].mean(axis=1), places[:, 0]]),
        )
    matched = np.array(places)
    before = np.zeros(0, dtype=int)
    for _ in range(MAX_MATCHING_STEPS):
        costs = _squared_distances(predicted[:, 1:] @ turn.T + place, places[:, 1:])
        orders = np.array([linear_sum_assignment(cost)[1] for cost in costs])
        if np.array_equal(orders, before):
            break
        before = orders
        matched[:, 1:] = np.take_along_axis(places[:, 1:], orders[:, :, None], axis=1)
        turn, place = register_points(predicted.reshape(-1, 3), matched.reshape(-1, 3))
    return turn, place


def _squared_distances(predicted: Array, points: Array) -> Array:
    """Return squared distances (T, n, n) between predicted (T, n, 3) and measured points (T, n, 3), mm^2.

    Missing coordinates do not count; a robot without an equilibrium has a large distance.
    """
    apart = np.nansum((predicted[:, :, None] - points[:, None]) ** 2, axis=3)
    failed = np.asarray(~np.isfinite(predicted).all(axis=2))[:, :, None]
    return np.where(failed & np.ones_like(apart, dtype=bool), LARGE_MISMATCH_MM**2, apart)


def _row_order_causes(search: CauseSearch, predicted: Array) -> Iterator[Cause]:
    """Yield the cause that rows of what was measured belong to configurations of other rows.

    predicted: (T, 1 + n, 3), places in the base's axes, mm.
    """
    measured = search.measured
    places = places_of(measured)
    order = np.arange(len(measured))
    for recording in range(measured.recordings):
        rows = np.flatnonzero(measured.recording == recording)
        if len(rows) > 2:
            order[rows] = rows[_match_rows(predicted[rows], places[rows], search.registered)]
    changed = np.flatnonzero(order != np.arange(len(order)))
    if len(changed):
        found = repair_rows(measured, np.arange(len(order)), order)
        yield Cause(row_order_words(measured, order), found, free_order=True)


def row_order_words(measured: Measurements, order: Index) -> str:
    """Return which rows are in another order, for a sentence; order: (T,), the row that belongs to each one."""
    changed = np.flatnonzero(order != np.arange(len(order)))
    if len(changed) == 2:
        first, second = (measured.place_of(int(row)) for row in changed)
        return f"what was measured is exchanged between {first} and {second}"
    pairs = [f"{measured.place_of(int(row))} fits {measured.place_of(int(order[row]))}" for row in changed[:3]]
    return (
        f"rows of what was measured are in another order than the configurations, in {len(changed)} of "
        f"{len(order)} rows (the configuration of {', of '.join(pairs)}{', ..' if len(changed) > 3 else ''})"
    )


def _match_rows(predicted: Array, places: Array, registered: bool) -> Index:
    """Return the row (T,) of places (T, n, 3) that belongs to each row of predicted ones (T, n, 3), mm.

    registered: whether both are in the same axes. If not, the rotation and the order are improved in turns, from
    the one that fits the given order, from those that bring the principal axes together, and from random ones.
    """
    if registered:
        return _assign_rows(predicted, places)[0]
    if any(np.isfinite(cloud).all(axis=2).sum() < LEAST_REGISTERED_POINTS for cloud in (predicted, places)):
        return np.arange(len(places))
    starts = [
        register_points(predicted.reshape(-1, 3), places.reshape(-1, 3))[0],
        *_starting_turns(predicted, places),
    ]
    best: tuple[Index, float] | None = None
    centre = np.nanmean(places.reshape(-1, 3), axis=0)
    for turn in starts:
        place = centre - turn @ np.nanmean(predicted.reshape(-1, 3), axis=0)
        before = np.zeros(0, dtype=int)
        for _ in range(MAX_MATCHING_STEPS):
            order, cost = _assign_rows(predicted @ turn.T + place, places)
            if np.array_equal(order, before):
                break
            before = order
            turn, place = register_points(predicted.reshape(-1, 3), places[order].reshape(-1, 3))
        if best is None or cost < best[1]:
            best = order, cost
    assert best is not None
    return best[0]


def _assign_rows(predicted: Array, places: Array) -> tuple[Index, float]:
    """Return the rows (T,) of places (T, n, 3) that fit predicted ones best, and the sum of squared distances."""
    # |a - b|^2 = |a|^2 - 2 a b + |b|^2 needs no array (T, T, n, 3); what was not measured is left out.
    known = np.isfinite(places).reshape(len(places), -1)
    seen = np.where(known, places.reshape(len(places), -1), 0.0)
    own = np.nan_to_num(predicted.reshape(len(predicted), -1), nan=LARGE_MISMATCH_MM)
    cost = own**2 @ known.T - 2 * own @ seen.T + (seen**2).sum(axis=1)
    rows, order = linear_sum_assignment(cost)
    return order, float(cost[rows, order].sum())


def _starting_turns(predicted: Array, places: Array) -> Iterator[Array]:
    """Yield rotations (3, 3) to start from: between principal axes of two clouds (T, n, 3), and random ones."""
    axes = []
    for cloud in (predicted.reshape(-1, 3), places.reshape(-1, 3)):
        known = cloud[np.isfinite(cloud).all(axis=1)]
        axes.append(np.linalg.svd(known - known.mean(axis=0), full_matrices=False)[2].T)
    for signs in itertools.product((1.0, -1.0), repeat=3):
        turn = axes[1] @ np.diag(signs) @ axes[0].T
        if np.linalg.det(turn) > 0:
            yield turn
    random = np.random.default_rng(0)
    for _ in range(RANDOM_MATCHING_STARTS):
        turn = np.linalg.qr(random.standard_normal((3, 3)))[0]
        yield turn * np.sign(np.linalg.det(turn))


def name_lines(measured: Measurements, rows: Index) -> str:
    """Return the names of some observations for a message, at most MAX_NAMED_LINES of them."""
    names = [measured.place_of(int(row)) for row in rows[:MAX_NAMED_LINES]]
    more = f" and {len(rows) - MAX_NAMED_LINES} more" if len(rows) > MAX_NAMED_LINES else ""
    return ", ".join(names) + more
