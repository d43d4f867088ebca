"""Scrambled Sobol points: those of scipy.stats.qmc.Sobol, whose import takes longer than to plan a motion.

In every dimension point n is the exclusive or of those direction numbers v_k whose bit is set in the Gray code
of n. From point n - 1 to point n a single bit of that code changes, so that a point costs one operation (Antonov
and Saleev, USSR Comput. Math. Math. Phys. 19(1), 1979). v_k = m_k / 2^k, with odd integers m_k from a recurrence
whose coefficients are those of a primitive polynomial (Joe and Kuo, below). Points are scrambled by random lower
triangular matrices over their binary digits and a random shift (Matousek, J. Complexity 14, 1998).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ctr_nlp.typing import Array

SOBOL_BITS = 30
"""Binary digits of a coordinate."""
JOE_KUO = (
    *((1, 1), (3, 1), (7, 1, 3), (11, 1, 3, 1), (13, 1, 1, 1), (19, 1, 1, 3, 3), (25, 1, 3, 5, 13)),
    *((37, 1, 1, 5, 5, 17), (41, 1, 1, 5, 5, 5), (47, 1, 1, 7, 11, 19), (55, 1, 1, 5, 1, 1), (59, 1, 1, 1, 3, 11)),
    *((61, 1, 3, 5, 5, 31), (67, 1, 3, 3, 9, 7, 49), (91, 1, 1, 1, 15, 21, 21), (97, 1, 3, 1, 13, 27, 49)),
    *((103, 1, 1, 1, 15, 7, 5), (109, 1, 3, 1, 15, 13, 25), (115, 1, 1, 5, 5, 19, 61)),
    *((131, 1, 3, 7, 11, 23, 15, 103), (137, 1, 3, 7, 13, 13, 15, 69), (143, 1, 1, 3, 13, 7, 35, 63)),
    *((145, 1, 3, 5, 9, 1, 25, 53), (157, 1, 3, 1, 13, 9, 35, 107), (167, 1, 3, 1, 5, 27, 61, 31)),
    *((171, 1, 1, 5, 11, 19, 41, 61),),
)
"""For each dimension a primitive polynomial, its coefficients as binary digits, and the first direction numbers.

S. Joe, F. Y. Kuo, "Constructing Sobol sequences with better two-dimensional projections", SIAM J. Sci. Comput. 30
(2008), new-joe-kuo-6.
"""


def sobol(count: int, dimensions: int, seed: int) -> Array:
    """Return the first `count` scrambled Sobol points (count, dimensions), each coordinate in [0, 1).

    seed: of numpy's default generator. From the 27th dimension on, coordinates are random numbers.
    """
    rng = np.random.default_rng(seed)
    known = min(dimensions, len(JOE_KUO))
    levels = max(count - 1, 1).bit_length()
    shift = rng.integers(2, size=(known, SOBOL_BITS), dtype=np.uint32)
    mixing = np.tril(rng.integers(2, size=(known, SOBOL_BITS, SOBOL_BITS), dtype=np.uint32))
    # A unit diagonal makes the matrices invertible over {0, 1}, so that scrambling keeps the points' even spread.
    mixing[:, range(SOBOL_BITS), range(SOBOL_BITS)] = 1
    directions = np.array([_directions(row, levels) for row in JOE_KUO[:known]])
    digits = directions[:, :, None] >> np.arange(SOBOL_BITS - 1, -1, -1) & 1
    weights = 1 << np.arange(SOBOL_BITS - 1, -1, -1)
    scrambled = np.einsum("dpk,djk->djp", mixing, digits) % 2 @ weights
    found = np.empty((count, known), dtype=np.int64)
    found[0] = shift @ weights[::-1]
    for number in range(1, count):
        # The lowest set bit of n is the one in which the Gray codes of n - 1 and n differ.
        found[number] = found[number - 1] ^ scrambled[:, (number & -number).bit_length() - 1]
    return np.hstack([found / 2.0**SOBOL_BITS, rng.random((count, dimensions - known))])


@lru_cache
def _directions(row: tuple[int, ...], levels: int) -> tuple[int, ...]:
    """Return the first `levels` direction numbers of a row of JOE_KUO as binary fractions of SOBOL_BITS digits."""
    polynomial = row[0]
    found = list(row[1:])
    degree = polynomial.bit_length() - 1
    # The first dimension has no polynomial: all its m_k are 1 (van der Corput), which the recurrence gives for x.
    if degree == 0:
        found = [1]
        degree = 1
        polynomial = 2
    while len(found) < levels:
        # m_k = 2 a_1 m_{k-1} xor 4 a_2 m_{k-2} xor .. xor 2^s m_{k-s} xor m_{k-s}, with a_s = 1 the last
        # coefficient.
        following = found[-degree]
        for back in range(1, degree + 1):
            following ^= (polynomial >> degree - back & 1) * found[-back] << back
        found.append(following)
    # m_k / 2^k for k = place + 1, as an integer over 2^SOBOL_BITS.
    return tuple(number << SOBOL_BITS - 1 - place for place, number in enumerate(found[:levels]))
