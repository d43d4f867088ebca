"""Faults that the checker must name, and good plans with which it must agree."""

import csv
import itertools

import pytest
from faults import FAULTS, insert
from random_plans import SAMPLES, random_plan

from ctr_nlp import Plan
from ctr_nlp.check.comparison import compare_verdicts
from ctr_nlp.check.records import check_plan

pytestmark = pytest.mark.interpreted
FAULT_COUNT = 1000
PLAN_COUNT = 1000
LOADED = 3
"""Last digit of the seeds whose robots are under a load: shapes, margins and clearances are not covered."""
QUICK_SEED = 6
"""Of two tubes on the elastic model in a lumen, a plan that can have every fault."""


def save(seed, folder, samples):
    """A random plan's file, and the table of the path that it was made for, in the file's axes."""
    plan = random_plan(seed, samples)
    path, source = folder / f"{seed}.npz", folder / f"{seed}.csv"
    plan.save(path)
    with open(source, "w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["x_mm", "y_mm", "z_mm"])
        table.writerows(plan.target[-1].tolist())
    return plan, path, source


def objections(path, source, samples):
    """Names of all that the checker objects to, or disagrees with the plan in."""
    found = check_plan(path, samples, source)
    return {each.name for each in compare_verdicts(found, {}) if not each.agrees} | {
        name for name, finding in found.findings.items() if finding.word == "no"
    }


def judge_faults(seed, folder, samples):
    """Names of the faults that one plan can have, and of those that the checker does not name."""
    _, path, source = save(seed, folder, samples)
    count = SAMPLES if samples else 0
    before = objections(path, source, count)
    tried, missed = [], []
    for number, fault in enumerate(FAULTS):
        bad = folder / "fault.npz"
        loaded = seed % 10 == LOADED and {*fault.findings} & {"shapes", "margins", "clearances"}
        if loaded or {*fault.findings} & before or not insert(fault, 100 * seed + number, path, bad):
            continue
        tried.append(fault.name)
        if not {*fault.findings} & objections(bad, source, count if fault.findings == ("samples",) else 0):
            missed.append((seed, fault.name))
    return tried, missed


@pytest.mark.hazard("wrong tube order", "wrong robot", "wrong frame of reference", "stale or mirrored wall")
def test_every_kind_of_fault_is_named(tmp_path):
    tried, missed = judge_faults(QUICK_SEED, tmp_path, samples=True)
    assert missed == []
    assert tried == [fault.name for fault in FAULTS]


@pytest.mark.parametrize("seed", [1, 2, 3, 8, 12, 18])
def test_good_plans_raise_no_false_alarm(seed, tmp_path):
    assert false_alarms(seed, tmp_path, samples=False) == []


def false_alarms(seed, folder, samples):
    _, path, source = save(seed, folder, samples)
    found = check_plan(path, SAMPLES if samples else 0, source)
    opinions = compare_verdicts(found, Plan.load(path).verdicts._asdict())
    return [(seed, each) for each in opinions if not each.agrees]


@pytest.mark.slow
@pytest.mark.hazard("mistake of the planner")
def test_thousand_faults_are_all_named(tmp_path):
    tried = 0
    missed = []
    for seed in itertools.count():
        names, own = judge_faults(seed, tmp_path, samples=seed % 4 == 0)
        tried += len(names)
        missed += own
        if tried >= FAULT_COUNT:
            break
    assert missed == []


@pytest.mark.slow
def test_thousand_good_plans_raise_no_false_alarm(tmp_path):
    found = [false_alarms(seed, tmp_path, samples=seed % 20 == 0) for seed in range(PLAN_COUNT)]
    assert list(itertools.chain(*found)) == []
