"""Which parameters the data identify, and which combinations of them they cannot tell apart, in words.

All is judged in units of the standard deviations sigma before measuring: with the data's information matrix I, the
scaled matrix is sigma I sigma. Along a unit vector v of these units the data bring v^T (sigma I sigma) v of
information, where 1 is as much as was known before.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_nlp.identify.calibration.fit import ParameterFit
from ctr_nlp.identify.calibration.parameters import DELAY, LAGS, MODULUS_KIND, Parameters
from ctr_nlp.typing import Array

DETERMINED = 0.5
"""A parameter is determined where at most this part of its standard deviation before measuring is left."""
MIN_IDENTIFIED_INFORMATION = 1.0
"""Least information along a direction of scaled parameters that the data identify; the prior's is 1."""
EXCLUDED_INFORMATION = 1e9
"""Information that is put on directions which are not to be looked at."""
MIN_NAMED_WEIGHT = 0.35
"""Parameters with at least this part of the largest entry of an unidentified direction are named."""


def classify_parameters(fit: ParameterFit) -> list[str]:
    """Classify every parameter of a fit.

    Parameters
    ----------
    fit : Fit
        The fit.

    Returns
    -------
    list of str
        ``"held"`` where the fit fixed the parameter at its mean before measuring; ``"determined"`` where at most
        half of its standard deviation before is left; else ``"partly"``.
    """
    names = {True: "determined", False: "partly"}
    return [
        "held" if held else names[bool(left <= DETERMINED)]
        for held, left in zip(fit.fixed, fit.sigma_ratio, strict=True)
    ]


def describe_unidentified(fit: ParameterFit) -> list[str]:
    """Say which parameters and combinations of parameters the data cannot identify.

    Parameters
    ----------
    fit : Fit
        The fit.

    Returns
    -------
    list of str
        Sentences: of combinations that no shape can show, of single parameters, and of further combinations.
    """
    parameters = fit.parameters
    scaled = fit.information * np.outer(parameters.sigma, parameters.sigma)
    sentences = list[str]()
    known = list[Array]()
    for direction, sentence in _invariances(parameters):
        # Under an arm that tilts, or a load, such a direction may well show itself.
        if direction @ scaled @ direction < MIN_IDENTIFIED_INFORMATION:
            known.append(direction)
            sentences.append(sentence)
    weak = np.flatnonzero(np.diag(scaled) < MIN_IDENTIFIED_INFORMATION)
    if len(weak):
        sentences.append(f"the data hardly tell {join_words([parameters.each[k].words for k in weak])}")
        known += list(np.eye(len(parameters))[weak])
    # Eigenvectors within what has been named already would only name it again, mixed: there the information is
    # raised beyond all others, so that weak eigenvectors lie in the rest.
    away = _orthogonal(known, len(parameters))
    sizes, axes = np.linalg.eigh(away @ scaled @ away + EXCLUDED_INFORMATION * (np.eye(len(parameters)) - away))
    sentences += [
        _describe_direction(parameters, axes[:, k])
        for k, size in enumerate(sizes)
        if size < MIN_IDENTIFIED_INFORMATION
    ]
    return list(dict.fromkeys(sentences))


def join_words(words: Sequence[str]) -> str:
    """Join words to a list in a sentence: a, b and c."""
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _invariances(parameters: Parameters) -> list[tuple[Array, str]]:
    """Directions of parameters along which no shape changes, and a sentence about each.

    Directions are unit vectors (P,) of parameters over their standard deviations before measuring.
    """
    found = list[tuple[Array, str]]()
    d = parameters.robot.d
    zeros = parameters.columns("motor_zero")
    rolls = parameters.columns("base_roll")
    if len(zeros) == d and rolls:
        # All tubes turned by an angle, and the base turned back by it, are the same shape for the sensor.
        direction = np.zeros(len(parameters))
        direction[zeros], direction[rolls] = 1.0, -1.0
        found.append((direction, "the common zero of all tubes cannot be told from the base's roll"))
    stiffness = parameters.columns("bending_stiffness")
    modulus = parameters.columns(MODULUS_KIND)
    if len(stiffness) == d:
        # Without a load, moments balance whatever unit stiffnesses are in; with one, the modulus is that unit.
        direction = np.zeros(len(parameters))
        direction[stiffness], direction[modulus] = 1.0, -1.0
        sentence = "only ratios of the tubes' stiffnesses show, not how stiff all are together"
        if modulus:
            sentence = "what is common to the tubes' stiffnesses cannot be told from their modulus"
        found.append((direction, sentence))
    # In units of the standard deviations before measuring, as information is looked at.
    scaled = [(direction / parameters.sigma, sentence) for direction, sentence in found]
    return [(direction / np.linalg.norm(direction), sentence) for direction, sentence in scaled]


def _orthogonal(directions: Sequence[Array], size: int) -> Array:
    """Return the projection (size, size) onto the complement of the span of directions (size,)."""
    if not directions:
        return np.eye(size)
    basis, _ = np.linalg.qr(np.stack(directions, axis=1))
    return np.asarray(np.eye(size) - basis @ basis.T)


def _describe_direction(parameters: Parameters, direction: Array) -> str:
    """Write the sentence for a direction (P,) of scaled parameters that the data do not determine."""
    weights = abs(direction) / abs(direction).max()
    chosen = sorted(np.flatnonzero(weights >= MIN_NAMED_WEIGHT), key=lambda k: -weights[k])
    each = [parameters.each[k] for k in chosen]
    names = join_words([one.words for one in each])
    if {one.kind for one in each} <= {*LAGS, DELAY} and len(each) > 1:
        return f"the data hardly tell {names} apart: at one speed these look alike"
    return f"the data hardly tell {names}{' apart' * (len(each) > 1)}"
