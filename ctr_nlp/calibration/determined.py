"""What data tell of parameters and what they cannot tell apart, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ctr_nlp.calibration.fit import Fit
from ctr_nlp.calibration.parameters import DELAY, LAGS, MODULUS, Parameters
from ctr_nlp.typing import Array

DETERMINED = 0.5
"""The data determine a parameter of whose standard deviation before they leave at most this part."""
TOLD = 1.0
"""A direction of parameters, each over its standard deviation before, of which data tell less is not told by them.
"""
BEYOND = 1e9
"""What stands for the information along directions that are not looked at."""
NAMED = 0.35
"""Parameters of at least this part of the largest in such a direction are named."""


def standing(fit: Fit) -> list[str]:
    """Of every parameter: determined, partly or held at the value of before."""
    names = {True: "determined", False: "partly"}
    return [
        "held" if held else names[bool(left <= DETERMINED)] for held, left in zip(fit.held, fit.left, strict=True)
    ]


def untold(fit: Fit) -> list[str]:
    """What the data do not tell or cannot tell apart, a sentence each."""
    parameters = fit.parameters
    scaled = fit.information * np.outer(parameters.sigma, parameters.sigma)
    sentences, known = list[str](), list[Array]()
    for direction, sentence in _invariances(parameters):
        if direction @ scaled @ direction < TOLD:
            known.append(direction)
            sentences.append(sentence)
    weak = np.flatnonzero(np.diag(scaled) < TOLD)
    if len(weak):
        sentences.append(f"the data hardly tell {listed([parameters.each[k].words for k in weak])}")
        known += list(np.eye(len(parameters))[weak])
    away = _orthogonal(known, len(parameters))
    sizes, axes = np.linalg.eigh(away @ scaled @ away + BEYOND * (np.eye(len(parameters)) - away))
    sentences += [_named(parameters, axes[:, k]) for k, size in enumerate(sizes) if size < TOLD]
    return list(dict.fromkeys(sentences))


def listed(words: Sequence[str]) -> str:
    """Words as a list in a sentence: a, b and c."""
    return " and ".join(filter(None, (", ".join(words[:-1]), words[-1])))


def _invariances(parameters: Parameters) -> list[tuple[Array, str]]:
    """Directions, over standard deviations and of length 1, along which no shape changes; what to say of them."""
    found, d = list[tuple[Array, str]](), parameters.robot.d
    zeros, rolls = parameters.columns("motor_zero"), parameters.columns("base_roll")
    if len(zeros) == d and rolls:
        direction = np.zeros(len(parameters))
        direction[zeros], direction[rolls] = 1.0, -1.0
        found.append((direction, "the common zero of all tubes cannot be told from the base's roll"))
    stiffness, modulus = parameters.columns("bending_stiffness"), parameters.columns(MODULUS)
    if len(stiffness) == d:
        direction = np.zeros(len(parameters))
        direction[stiffness], direction[modulus] = 1.0, -1.0
        sentence = "only ratios of the tubes' stiffnesses show, not how stiff all are together"
        if modulus:
            sentence = "what is common to the tubes' stiffnesses cannot be told from their modulus"
        found.append((direction, sentence))
    scaled = [(direction / parameters.sigma, sentence) for direction, sentence in found]
    return [(direction / np.linalg.norm(direction), sentence) for direction, sentence in scaled]


def _orthogonal(directions: Sequence[Array], size: int) -> Array:
    """What takes directions out of vectors (size,)."""
    if not directions:
        return np.eye(size)
    basis, _ = np.linalg.qr(np.stack(directions, axis=1))
    return np.asarray(np.eye(size) - basis @ basis.T)


def _named(parameters: Parameters, direction: Array) -> str:
    """A sentence for a direction of which the data tell nothing."""
    weights = abs(direction) / abs(direction).max()
    chosen = sorted(np.flatnonzero(weights >= NAMED), key=lambda k: -weights[k])
    each = [parameters.each[k] for k in chosen]
    names = listed([one.words for one in each])
    if {one.kind for one in each} <= {*LAGS, DELAY} and len(each) > 1:
        return f"the data hardly tell {names} apart: at one speed these look alike"
    return f"the data hardly tell {names}{' apart' * (len(each) > 1)}"
