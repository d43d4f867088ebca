"""Prediction of measurements for given values of a robot's parameters, and its derivatives over these.

The prediction h_k(p) of docs/method.md, "Calibration", has four steps: backlash, drag, the sensor's
delay and the motors' zeros give the configuration of the tubes; the model gives the equilibrium x there; points
are computed in the base's axes; and these are rotated and translated to the sensor's axes. Derivatives follow from
the implicit function theorem for the tubes' numbers and the configuration (sensitivities.py), in closed form for
offsets and positions, and by finite differences for backlash, delay and rotations of the base.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from ctr_nlp.identify.calibration.measurements import Measurements
from ctr_nlp.identify.calibration.parameters import (
    BASE,
    DELAY,
    DEVIATION_NAMES,
    LAGS,
    MODULUS_KIND,
    OFFSET,
    Parameters,
)
from ctr_nlp.identify.calibration.sensitivities import shape_derivatives_at_q
from ctr_nlp.models import Model
from ctr_nlp.models.loads import Load, require_constant_load
from ctr_nlp.models.protocol import MotionSubsteps
from ctr_nlp.plan.backlash import delay_configurations
from ctr_nlp.robot.samples import perturb_robot
from ctr_nlp.typing import Array, Flags

TIP_DIFFERENCE_SPACING = 2e-3
"""Distance of the points at the tip whose differences give its direction, as a part of the robot's length."""
STENCIL = np.array([3.0, -4.0, 1.0])
"""Weights of the tip and of the points one and two steps h before it: the one-sided second-order difference
(3 f_0 - 4 f_1 + f_2) / (2 h), without its divisor, since only the direction is used."""
NUMERICAL_DERIVATIVE_STEP = 1e-6
"""Step of numerical derivatives over rotations of the base, rad, over delays, s, and over parameters of lags."""


class ObservableValues(NamedTuple):
    """Measurable values of T observations.

    As derivatives over P parameters each array has a further, last axis (P,).

    Attributes
    ----------
    tip : (T, 3) array
        The tip, mm.
    direction : (T, 3) array
        Unit tangents at the tip.
    points : (T, n, 3) array
        Points of the shape, mm.
    """

    tip: Array
    direction: Array
    points: Array

    def flat(self) -> Array:
        """Return all values of an observation side by side, (T, 6 + 3n), or (T, 6 + 3n, P) of derivatives."""
        rows = len(self.tip), -1
        return np.concatenate(
            [self.tip, self.direction, self.points.reshape(*rows, *self.points.shape[3:])], axis=1
        )


class Prediction:
    """Predicts measurements at their configurations, for values of the parameters.

    Parameters
    ----------
    parameters : Parameters
        The P parameters.
    measured : Measurements
        The T observations: configurations, times, positions of points on the robot and forces at the tip.
    model : Model
        The kinematic model. Where a force acts in any observation it must be one of loaded robots; its own load
        acts in all of them.
    bases : list of (rotation, place), optional
        For every recording the initial pose of the base in the sensor's axes: (3, 3), and (3,) mm. By default the
        sensor's axes are the base's.

    Raises
    ------
    LoadError
        The model's load changes over time.
    """

    def __init__(
        self,
        parameters: Parameters,
        measured: Measurements,
        model: Model,
        bases: list[tuple[Array, Array]] | None = None,
    ) -> None:
        self.parameters = parameters
        self.measured = measured
        self._model = model
        self.bases = bases or [(np.eye(3), np.zeros(3))] * measured.recordings
        count = len(measured)
        d = parameters.robot.d
        load = Load() if model.applied_load is None else require_constant_load(model.applied_load, "a calibration")
        self._loads = np.tile(load.numbers(d), (count, 1))
        self._loads[:, :3] += measured.force
        # The tip and two points just before it, which give its direction, come before the measured points.
        tip = np.broadcast_to([1.0, 1.0 - TIP_DIFFERENCE_SPACING, 1.0 - 2 * TIP_DIFFERENCE_SPACING], (count, 3))
        # Missing points are evaluated at the tip: arrays stay rectangular, and their residuals are NaN.
        self._sigma = np.hstack([tip, np.where(np.isfinite(measured.sigma), measured.sigma, 1.0)])

    def with_measurements(self, measured: Measurements) -> Prediction:
        """Return predictions of other measurements, with the same parameters, model and initial bases.

        Parameters
        ----------
        measured : Measurements
            The observations.

        Returns
        -------
        Prediction
            Their predictions.
        """
        return Prediction(self.parameters, measured, self._model, self.bases)

    def predict_values(self, values: Array) -> ObservableValues:
        """Predict the measured values.

        Parameters
        ----------
        values : (P,) array
            Values of the parameters.

        Returns
        -------
        ObservableValues
            In the sensor's axes; NaN where the robot has no equilibrium.
        """
        return self._for_sensor(values, self._in_base(values, *self._equilibria(values))[0])

    def predict_with_derivatives(self, values: Array, rows: Flags | None = None) -> tuple[ObservableValues, Array]:
        """Predict the measured values and their derivatives.

        Parameters
        ----------
        values : (P,) array
            Values of the parameters.
        rows : (T,) array of bool, optional
            Observations whose derivatives are wanted, by default all.

        Returns
        -------
        seen : ObservableValues
            In the sensor's axes; NaN where the robot has no equilibrium.
        changes : (T, 6 + 3n, P) array
            Derivatives over the parameters, in the order of :meth:`ObservableValues.flat`; 0 in other rows, and
            where the robot has no equilibrium or is at a fold, where derivatives are infinite.
        """
        x, numbers = self._equilibria(values)
        inside, ahead = self._in_base(values, x, numbers)
        asked = np.asarray(np.isfinite(x).all(axis=1) & (True if rows is None else rows))
        over = self._in_base_derivatives(values, x, numbers, asked)
        changes = np.where(asked[:, None, None], self._changes(values, inside, ahead, over), 0.0)
        return self._for_sensor(values, inside), changes

    def configurations(self, values: Array) -> Array:
        """Compute the configurations of the tubes at the times of the measurements.

        Parameters
        ----------
        values : (P,) array
            Values of the parameters.

        Returns
        -------
        (T, 2d + 2) array
            Configurations with backlash and drag, the sensor's delay, and the motors' zeros; rad, mm and rad.
        """
        parameters = self.parameters
        measured = self.measured
        q = measured.q
        if parameters.columns(*LAGS):
            q = parameters.lag(values).apply_to_motion(parameters.robot, q, measured.time, measured.fresh)
        if parameters.columns(DELAY):
            q = delay_configurations(q, measured.time, parameters.delay(values), measured.fresh)
        q = np.array(q)
        # Last: zeros are constant turns of tubes against motors, to which backlash and delay do not apply.
        q[:, : parameters.robot.d] += parameters.of_tubes(values, "motor_zero")
        return q

    def _equilibria(self, values: Array) -> tuple[Array, Array]:
        """Find the equilibria x (T, n_x) for values (P,), and the tubes' numbers (d, 8)."""
        parameters = self.parameters
        measured = self.measured
        parts = parameters.parts(values)[None]
        numbers = perturb_robot(parameters.robot, parts, np.zeros(parts.shape[:2])).numbers
        count = len(measured)
        q = self.configurations(values)
        way = MotionSubsteps(q, np.arange(count), measured.fresh, count)
        at = parameters.structure
        if self._model.applied_load is None:
            found = self._model.follow_batch(at, numbers, way, q[None], False)
        elif measured.has_times:
            found = self._model.follow_with_loads(self._loads[None], at, numbers, way, q[None], False)
        else:  # poses without a motion between them are one batch of robots, which is much faster
            each = np.repeat(numbers, count, axis=0)
            way = MotionSubsteps(q[:1], way.frames[:1], way.fresh[:1], 1)
            found = self._model.follow_with_loads(self._loads[:, None], at, each, way, q[:, None], False)
        return np.concatenate([one.x for one in found]), numbers[0]

    def _in_base(self, values: Array, x: Array, numbers: Array) -> tuple[ObservableValues, Array]:
        """Return the observable values in the base's axes, at unknowns x (T, n_x) and the tubes' numbers (d, 8).

        Also returns the vectors (T, 3) along the tip before they are normalised.
        """
        at = self.parameters.structure, numbers[None]
        if self._model.applied_load is None:
            (points,) = self._model.points_batch(*at, x[None], self._sigma)
        else:
            points = self._model.points_with_loads(self._loads, *at, x, self._sigma)
        # A difference of points, and not the model's own tangent, so that derivatives of points are all that is
        # needed.
        ahead = np.einsum("k,tka->ta", STENCIL, points[:, :3])
        direction = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
        offset = sum(values[k] for k in self.parameters.columns(OFFSET))
        return ObservableValues(points[:, 0] + offset * direction, direction, points[:, 3:]), ahead

    def _in_base_derivatives(self, values: Array, x: Array, numbers: Array, rows: Flags) -> Array:
        """Return derivatives (T, n + 3, 3, P) of points in the base's axes over parameters of tubes and motors.

        values: (P,). x: (T, n_x), unknowns. numbers: (d, 8) of the tubes. 0 for the other parameters, and outside
        rows (T,).
        """
        parameters, (count, places) = self.parameters, self._sigma.shape
        found = np.zeros((count, places, 3, len(values)))
        columns = parameters.columns(*DEVIATION_NAMES, MODULUS_KIND, *LAGS, DELAY)
        if not columns:
            return found
        function = shape_derivatives_at_q(self._model, parameters.structure, places)
        # Numbers (d, 8) are columns of symbols, tube after tube within each number: Fortran's order.
        over = np.stack([parameters.numbers_derivative(k).ravel(order="F") for k in columns], axis=1)
        moved = self._configuration_derivatives(values, columns)
        for row in np.flatnonzero(rows):
            given = x[row], self._sigma[row], numbers, [] if self._model.applied_load is None else self._loads[row]
            of_numbers, of_q = (each.full() for each in function(*given))
            # Chain rule: over the tubes' numbers, and over the configuration, which backlash, delay and zeros
            # change. Near a fold both parts may be infinite.
            change = np.nan_to_num(of_numbers @ over + of_q @ moved[row], posinf=0.0, neginf=0.0)
            found[row][..., columns] = change.reshape(3, places, len(columns)).swapaxes(0, 1)
        return found

    def _configuration_derivatives(self, values: Array, columns: list[int]) -> Array:
        """Return derivatives (T, 2d + 2, n) of configurations over the parameters at n columns."""
        parameters = self.parameters
        here = self.configurations(values)
        found = np.zeros((*here.shape, len(columns)))
        for place, k in enumerate(columns):
            one = parameters.each[k]
            if one.kind in (*LAGS, DELAY):
                changed = np.array(values)
                changed[k] += NUMERICAL_DERIVATIVE_STEP
                found[..., place] = (self.configurations(changed) - here) / NUMERICAL_DERIVATIVE_STEP
            elif one.kind == "motor_zero":
                found[:, parameters.tube(k), place] = 1.0
        return found

    def _changes(self, values: Array, inside: ObservableValues, ahead: Array, over: Array) -> Array:
        """Return derivatives (T, 6 + 3n, P) of the measured values from those of points in the base's axes.

        values: (P,). inside: observable values in the base's axes. ahead: (T, 3), vectors along the tip. over:
        (T, n + 3, 3, P), derivatives of points.
        """
        parameters = self.parameters
        turns = self._turns(values)[self.measured.recording]
        along = np.einsum("k,tkap->tap", STENCIL, over[:, :3]) / np.linalg.norm(ahead, axis=1)[:, None, None]
        # A unit vector t = v / |v| changes only perpendicular to itself: dt = (1 - t t^T) dv / |v|.
        along -= inside.direction[..., None] * np.einsum("ta,tap->tp", inside.direction, along)[:, None]
        tip = np.array(over[:, 0])
        offsets = parameters.columns(OFFSET)
        # The sensor sits an offset beyond the tip, along it: tip + offset t.
        tip += sum(values[k] for k in offsets) * along
        for k in offsets:
            tip[..., k] += inside.direction
        changes = ObservableValues(tip, along, over[:, 3:])
        found = ObservableValues(*(np.einsum("tab,t...bp->t...ap", turns, part) for part in changes))
        self._add_bases(values, inside, found)
        return found.flat()

    def _add_bases(self, values: Array, inside: ObservableValues, found: ObservableValues) -> None:
        """Add the derivatives over poses of bases to `found`; inside: observable values in the base's axes."""
        recording = self.measured.recording
        for axis, kind in enumerate(BASE):
            for k in self.parameters.columns(kind):
                own = recording == (self.parameters.each[k].number or 1) - 1
                if axis < 3:
                    found.tip[own, axis, k] += 1.0
                    found.points[own, :, axis, k] += 1.0
                    continue
                # Rotation vectors do not add up; central differences of the rotation are exact to 1e-10.
                ends = [np.array(values), np.array(values)]
                ends[0][k] += NUMERICAL_DERIVATIVE_STEP
                ends[1][k] -= NUMERICAL_DERIVATIVE_STEP
                turn = (self._turns(ends[0]) - self._turns(ends[1]))[recording[own]] / (
                    2 * NUMERICAL_DERIVATIVE_STEP
                )
                for part, vectors in zip(found, inside, strict=True):
                    part[own, ..., k] += np.einsum("tab,t...b->t...a", turn, vectors[own])

    def _for_sensor(self, values: Array, inside: ObservableValues) -> ObservableValues:
        """Transform observable values from the base's axes to the sensor's; values: (P,) of the parameters."""
        recording = self.measured.recording
        turns = self._turns(values)[recording]
        places = self._places(values)[recording]
        turned = [np.einsum("tab,t...b->t...a", turns, part) for part in inside]
        return ObservableValues(turned[0] + places, turned[1], turned[2] + places[:, None])

    def bases_at(self, values: Array) -> tuple[tuple[Array, Array], ...]:
        """Return rotation (3, 3) and origin (3,), mm, of each recording's base for the sensor; values: (P,)."""
        return tuple(zip(self._turns(values), self._places(values), strict=True))

    def _turns(self, values: Array) -> Array:
        """Return rotations (recordings, 3, 3) from the bases' axes to the sensor's; values: (P,)."""
        vectors = self._of_bases(values, BASE[3:])
        rotations = Rotation.from_rotvec(vectors).as_matrix()
        # Small rotations about the base's own axes, behind those that registration has found: far from the
        # singularity of rotation vectors, and the roll is one about the base's z.
        return np.stack([turn for turn, _ in self.bases]) @ rotations

    def _places(self, values: Array) -> Array:
        """Return the bases' origins (recordings, 3) in the sensor's axes, mm; values: (P,)."""
        return np.stack([place for _, place in self.bases]) + self._of_bases(values, BASE[:3])

    def _of_bases(self, values: Array, kinds: tuple[str, ...]) -> Array:
        """Return the values (recordings, n) of n kinds of parameters of bases, from values (P,)."""
        found = np.zeros((len(self.bases), len(kinds)))
        for axis, kind in enumerate(kinds):
            for k in self.parameters.columns(kind):
                found[(self.parameters.each[k].number or 1) - 1, axis] = values[k]
        return found


def build_registered_prediction(parameters: Parameters, measured: Measurements, model: Model) -> Prediction:
    """Build the predictions, with bases registered to the measurements of each recording.

    The base's pose may be anything before measuring. Starting from the pose in which the nominal robot fits best,
    a fit has only small rotations to find.

    Parameters
    ----------
    parameters : Parameters
        What is estimated; where the base's pose is not among it, the sensor's axes are the base's.
    measured : Measurements
        The observations.
    model : Model
        The kinematic model, under a load where one acts.

    Returns
    -------
    Prediction
        The predictions.
    """
    prediction = Prediction(parameters, measured, model)
    if not parameters.columns(*BASE):
        return prediction
    seen = prediction.predict_values(parameters.mean)
    bases = []
    for recording in range(measured.recordings):
        own = measured.recording == recording
        pairs = ((seen.tip, measured.tip), (seen.points, measured.points))
        predicted, there = (np.concatenate([pair[k][own].reshape(-1, 3) for pair in pairs]) for k in range(2))
        bases.append(register_points(predicted, there))
    return Prediction(parameters, measured, model, bases)


def flat_measured(measured: Measurements) -> Array:
    """Return measured values as rows (T, 6 + 3n), in the order of :meth:`ObservableValues.flat`."""
    return ObservableValues(measured.tip, measured.direction, measured.points).flat()


def register_points(points: Array, measured: Array) -> tuple[Array, Array]:
    """Find the rigid motion that brings points closest to measured ones, in the least mean square.

    Kabsch, A solution for the best rotation to relate two sets of vectors, Acta Crystallographica A32, 1976.

    Parameters
    ----------
    points : (K, 3) array
        Points, mm.
    measured : (K, 3) array
        Where these were measured, mm. Rows in which either is NaN do not count.

    Returns
    -------
    rotation : (3, 3) array
        With determinant 1.
    place : (3,) array
        Translation after the rotation, mm.
    """
    known = np.isfinite(points).all(axis=1) & np.isfinite(measured).all(axis=1)
    own = points[known]
    there = measured[known]
    if not len(own):
        return np.eye(3), np.zeros(3)
    centres = own.mean(axis=0), there.mean(axis=0)
    u, _, v = np.linalg.svd((own - centres[0]).T @ (there - centres[1]))
    # Without this sign the best orthogonal matrix of points in a plane, or with noise, may be a mirror.
    mirrored = np.sign(np.linalg.det(u @ v))
    turn = v.T @ np.diag([1.0, 1.0, mirrored]) @ u.T
    return turn, centres[1] - turn @ centres[0]
