"""Sobol points beside those of scipy, which are the same."""

import numpy as np
import pytest
from scipy.stats import qmc

from ctr_nlp.support.sobol import JOE_KUO, sobol


@pytest.mark.parametrize("dimensions", [1, 2, 6, 8, 12, len(JOE_KUO)])
@pytest.mark.parametrize("seed", [0, 7])
def test_points_are_those_of_scipy_to_the_last_digit(dimensions, seed):
    for levels in (0, 1, 4, 8):
        expected = qmc.Sobol(dimensions, seed=seed).random_base2(levels)
        np.testing.assert_array_equal(sobol(2**levels, dimensions, seed), expected)
    np.testing.assert_array_equal(sobol(5, dimensions, seed), qmc.Sobol(dimensions, seed=seed).random_base2(3)[:5])


def test_beyond_the_known_dimensions_there_are_random_coordinates():
    points = sobol(64, len(JOE_KUO) + 4, 0)
    assert points.shape == (64, len(JOE_KUO) + 4)
    assert ((points >= 0) & (points < 1)).all()
    assert (np.ptp(points, axis=0) > 0.8).all()
