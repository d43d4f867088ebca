"""A band over all frames with a border: the solution is that of the whole dense system."""

from __future__ import annotations

import numpy as np
import pytest

from ctr_nlp.solvers.scenarios.bordered import solve_bordered_system

FRAMES, N, P = 4, 3, 2


@pytest.fixture
def system():
    """Blocks of frames over q and p, a band that links neighbours, more over p, and the same as one matrix."""
    random = np.random.default_rng(5)
    roots = random.normal(size=(FRAMES, N + P, N + P + 2))
    blocks = roots @ roots.swapaxes(1, 2)
    links = np.zeros((2 * N, FRAMES * N))
    links[0], links[N, :-N] = 2.0, -1.0
    corner, diagonal = np.eye(P), random.uniform(0.1, 1.0, FRAMES * N + P)
    size = FRAMES * N
    whole = np.zeros((size + P, size + P))
    for t, block in enumerate(blocks):
        at = np.r_[t * N : (t + 1) * N, size : size + P]
        whole[np.ix_(at, at)] += block
    whole[:size, :size] += 2 * np.eye(size) - np.eye(size, k=N) - np.eye(size, k=-N)
    whole[size:, size:] += corner
    return links, blocks, corner, diagonal, random.normal(size=size + P), whole + np.diag(diagonal)


def test_the_solution_is_that_of_the_whole_system(system):
    *parts, right, whole = system
    found = solve_bordered_system(*parts, right, np.ones(len(right), dtype=bool))
    np.testing.assert_allclose(found, np.linalg.solve(whole, right), rtol=1e-9)


def test_fixed_unknowns_stay_and_the_others_are_solved_for(system):
    *parts, right, whole = system
    free = np.ones(len(right), dtype=bool)
    free[[1, -1]] = False
    found = solve_bordered_system(*parts, right, free)
    assert not found[~free].any()
    expected = np.linalg.solve(whole[np.ix_(free, free)], right[free])
    np.testing.assert_allclose(found[free], expected, rtol=1e-6)  # held by a large number, not taken out


def test_without_common_unknowns_there_is_the_band_alone(system):
    links, blocks, _, diagonal, right, whole = system
    size = FRAMES * N
    found = solve_bordered_system(
        links, blocks[:, :N, :N], np.zeros((0, 0)), diagonal[:size], right[:size], np.ones(size, dtype=bool)
    )
    np.testing.assert_allclose(found, np.linalg.solve(whole[:size, :size], right[:size]), rtol=1e-9)


@pytest.mark.parametrize("where", ["band", "border"])
def test_a_system_that_is_not_positive_definite_has_none(system, where):
    links, blocks, corner, diagonal, right, _ = system
    if where == "band":
        links[0] -= 1e3
    else:
        corner = corner - 1e3 * np.eye(P)
    assert solve_bordered_system(links, blocks, corner, diagonal, right, np.ones(len(right), dtype=bool)) is None
