"""Projections of large studies: their arithmetic, and a small simulated one."""

from __future__ import annotations

import math
import os

import pytest
from study_costs.pool_comparison import PoolComparison, Turn, compare_with_pool, rows_of
from study_costs.scale import Sleeper, StudyCost, project_study, simulate_study, sleeper_study

from ctr_nlp.exceptions import BenchmarkError
from ctr_nlp.studies.grid.case import Case
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers.batches import (
    FIRST_BATCH_CASES,
    MIN_BATCH_S,
    MIN_BATCH_SPACING_S,
    target_batch_seconds,
)
from ctr_nlp.studies.workers.running import BATCHES_PER_WORKER

COST = StudyCost(0.002, 0.0001, 0.004, 0.0002, 0.00001, 1000.0, 500.0, 2000.0)


def test_a_projection_worked_by_hand():
    """4 workers: 12 batches of 2, then 1,000 plans of 0.5 s in batches of 4; the workers are the slowest."""
    found = project_study(1024, 4, 0.5, COST)
    assert found.batches == 12 + 250
    assert found.tasks == 12
    assert found.wall_s == pytest.approx(1024 * 0.00001 + 128.0 + 1.0)
    assert found.efficiency == pytest.approx(128.0 / found.wall_s)
    assert found.client_share == pytest.approx((262 * 0.002 + 0.1024) / found.wall_s)
    assert found.scheduler_share == pytest.approx((262 * 0.004 + 0.2048) / found.wall_s)
    assert (found.messages_bytes, found.rows_bytes, found.client_bytes) == (1024e3, 512e3, 2048e3)


def test_a_client_that_cannot_keep_up_decides():
    """1,000 workers do 100,024 plans of 1 ms in 0.1 s; giving and collecting the batches takes longer."""
    found = project_study(100_024, 1000, 0.001, StudyCost(0.002, 0.0001, 0.004, 0.0002, 0.0, 0.0, 0.0, 0.0))
    first = FIRST_BATCH_CASES * BATCHES_PER_WORKER * 1000
    batches = first / 2 + (100_024 - first) / 200
    assert found.wall_s == pytest.approx(0.006 * batches + 0.0003 * 100_024)
    assert found.client_share + found.scheduler_share == pytest.approx(1.0)


def test_batches_of_many_workers_last_longer():
    assert target_batch_seconds(2) == MIN_BATCH_S
    assert target_batch_seconds(1000) == MIN_BATCH_SPACING_S * 1000


def test_a_simulated_study_gives_the_batches_that_are_projected():
    pytest.importorskip("distributed", reason="the extra `study` is not installed")
    found, told = simulate_study([0.1] * 300, 4), project_study(300, 4, 0.1, COST)
    assert found.batches == pytest.approx(told.batches, rel=0.2)
    assert found.tasks <= 2 * told.tasks
    assert found.rows_bytes > 0
    assert found.wall_s > 300 * 0.1 / 4
    assert math.isnan(found.client_share)


@pytest.mark.slow
def test_a_study_is_compared_with_a_pool_that_makes_the_same_plans():
    pytest.importorskip("distributed", reason="the extra `study` is not installed")
    found = compare_with_pool(sleeper_study([0.01] * 8), 2, pairs=2)
    assert len(found.study) == len(found.pool) == 2
    assert all(turn.processor_s > 0 and turn.page_faults > 0 for turn in (*found.study, *found.pool))
    assert all(turn.memory_bytes[-1] > 1e7 for turn in found.study)
    assert not any(turn.memory_bytes for turn in found.pool)
    assert found.ratio > 0
    assert [row[0] for row in rows_of(found)] == ["study", "study", "pool", "pool"]


def test_a_ratio_is_the_median_over_pairs():
    pool = tuple(Turn(user, 0.5, 1, ()) for user in (0.5, 1.5, 3.5))
    study = tuple(Turn(user, 1.0, 1, ()) for user in (0.0, 3.0, 3.0))
    assert PoolComparison(study, pool).ratio == pytest.approx(1.0)


def test_a_side_of_a_comparison_that_dies_is_an_error():
    with pytest.raises(BenchmarkError, match="ended early"):
        compare_with_pool(Study("deadly", (made_deadly(sleeper_study([0.0]).cases[0]),)), 1)


class Deadly(Sleeper):
    """A case that ends the process that makes it."""

    def row(self, keep=None):
        os._exit(1)


def made_deadly(case):
    return Deadly(**{name: getattr(case, name) for name in Case.__dataclass_fields__})
