"""Robots that move on: the equilibria of the rest of a motion are those of the whole."""

import numpy as np
import pytest
from near_fold import LONG

from ctr_nlp.models.elastic import Elastic
from ctr_nlp.models.elastic.history import ElasticWithHistory
from ctr_nlp.models.protocol import subdivide_motion
from ctr_nlp.robot.samples import sample_robots

FIRST, SUBSTEPS = 20, 4


@pytest.fixture(scope="module")
def q():
    """The outer tube is turned by nearly a whole turn while it is hardly out, and back when it is: from frame 20
    on it stands where it would not be if it had been turned there from where tubes are aligned.
    """
    found = np.zeros((30, 6))
    found[:, 0] = np.interp(np.arange(30), [0, 9, 14, 19, 29], [0.0, 5.5, 5.5, 4.0, 3.6])
    found[:, 2:4] = np.interp(np.arange(30), [9, 14], [10.0, 60.0])[:, None] + [0.0, 20.0]
    return found


def test_the_rest_is_followed_as_in_the_whole_motion(q):
    whole = Elastic().follow(LONG, q)
    rest = ElasticWithHistory(q[:FIRST]).follow(LONG, q[FIRST:])
    for name in ("x", "stability", "stability_between"):
        np.testing.assert_allclose(getattr(rest, name), getattr(whole, name)[FIRST:], atol=1e-9)
    alone = Elastic().follow(LONG, q[FIRST:])
    assert abs(alone.x - rest.x)[:, 0].min() > 1.0, "without its way the robot would be in another equilibrium"


def test_it_rests_where_its_way_has_led_it(q):
    model = ElasticWithHistory(q[:FIRST])
    np.testing.assert_allclose(model.rest(LONG, q[FIRST]), model.follow(LONG, q[FIRST:]).x[0], atol=1e-9)


def test_an_equilibrium_that_is_given_counts_more_than_the_way(q):
    alone = Elastic().follow(LONG, q[FIRST:])
    given = ElasticWithHistory(q[:FIRST]).follow(LONG, q[FIRST:], alone.x[0])
    np.testing.assert_allclose(given.x, alone.x, atol=1e-6)


def test_draws_are_followed_as_in_the_whole_motion(q):
    draws = sample_robots(LONG, 5, 1)
    whole, rest = subdivide_motion(q, SUBSTEPS), subdivide_motion(q[FIRST:], SUBSTEPS)
    at = draws.structure, draws.numbers
    expected = Elastic().follow_batch(*at, whole, draws.tube_configurations(whole.q, whole.fresh))
    found = ElasticWithHistory(q[:FIRST]).follow_batch(*at, rest, draws.tube_configurations(rest.q, rest.fresh))
    for own, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(own.x, other.x[FIRST:], atol=1e-6)
        np.testing.assert_allclose(own.stability, other.stability[FIRST:], atol=1e-6)
        assert [snap.frame for snap in own.snaps] == [max(snap.frame - FIRST, 1) for snap in other.snaps]
