"""Identifiable parameters of a calibration, and combinations that the data do not identify, in words.

Parameters are scaled by their prior standard deviations sigma: with the data's information matrix I, the scaled
one is sigma I sigma. Along a unit vector v of scaled parameters the data have the information v^T (sigma I sigma)
v, where 1 is as much as the prior has. Eigenvectors with less than that are not identified.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_nlp.identify.calibration.fit import ParameterFit
from ctr_nlp.identify.calibration.parameters import DELAY, LAGS, MODULUS_KIND, Parameters
from ctr_nlp.typing import Array

DETERMINED = 0.5
"""A parameter is determined where its posterior standard deviation is at most this part of the prior's."""
MIN_IDENTIFIED_INFORMATION = 1.0
"""Least information along a direction of scaled parameters that the data identify; the prior's is 1."""
EXCLUDED_INFORMATION = 1e9
"""Information that is added along directions which have been named already."""
MIN_NAMED_WEIGHT = 0.35
"""Parameters with at least this part of the largest entry of an unidentified direction are named."""


def classify_parameters(fit: ParameterFit) -> list[str]:
    """Classify every parameter of a fit.

    Parameters
    ----------
    fit : ParameterFit
        The fit.

    Returns
    -------
    list of str
        ``"held"`` where the fit fixed the parameter at its prior mean; ``"determined"`` where its posterior
        standard deviation is at most half of the prior's; else ``"partly"``.
    """
    names = {True: "determined", False: "partly"}
    return [
        "held" if held else names[bool(left <= DETERMINED)]
        for held, left in zip(fit.fixed, fit.sigma_ratio, strict=True)
    ]


def describe_unidentified(fit: ParameterFit) -> list[str]:
    """Describe the parameters and combinations of parameters that the data do not identify.

    Parameters
    ----------
    fit : ParameterFit
        The fit.

    Returns
    -------
    list of str
        Sentences: on combinations that change no shape, on single parameters, and on further combinations.
    """
    parameters = fit.parameters
    scaled = fit.information * np.outer(parameters.sigma, parameters.sigma)
    sentences = list[str]()
    known = list[Array]()
    for direction, sentence in _invariances(parameters):
        # With a tilting arm, or under a load, the data may identify such a direction after all.
        if direction @ scaled @ direction < MIN_IDENTIFIED_INFORMATION:
            known.append(direction)
            sentences.append(sentence)
    weak = np.flatnonzero(np.diag(scaled) < MIN_IDENTIFIED_INFORMATION)
    if len(weak):
        sentences.append(f"the data barely determine {join_words([parameters.each[k].words for k in weak])}")
        known += list(np.eye(len(parameters))[weak])
    # Deflation: eigenvectors in the span of what has been named would only name it again, in a mixture. There the
    # information is raised beyond all others, so that weak eigenvectors lie in the complement.
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
    """Return directions of parameters along which no shape changes, and a sentence on each.

    Directions are unit vectors (P,) of parameters over their prior standard deviations.
    """
    found = list[tuple[Array, str]]()
    d = parameters.robot.d
    zeros = parameters.columns("motor_zero")
    rolls = parameters.columns("base_roll")
    if len(zeros) == d and rolls:
        # All tubes turned by an angle, and the base turned back by it, are the same shape for the sensor.
        direction = np.zeros(len(parameters))
        direction[zeros], direction[rolls] = 1.0, -1.0
        found.append((direction, "a common zero of all tubes cannot be distinguished from the base's roll"))
    stiffness = parameters.columns("bending_stiffness")
    modulus = parameters.columns(MODULUS_KIND)
    if len(stiffness) == d:
        # Without a load only ratios of stiffnesses enter the balance of moments; with one, the modulus scales all.
        direction = np.zeros(len(parameters))
        direction[stiffness], direction[modulus] = 1.0, -1.0
        sentence = "the data determine only the ratios of the tubes' stiffnesses, not a common factor"
        if modulus:
            sentence = "a common factor of the tubes' stiffnesses cannot be distinguished from their modulus"
        found.append((direction, sentence))
    # A change of one unit of a parameter is 1 / sigma of its scaled one.
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
        return f"the data barely distinguish {names}: at one speed their effects look alike"
    return f"the data barely {'distinguish' if len(each) > 1 else 'determine'} {names}"
