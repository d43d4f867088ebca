"""Studies of many plans: what a file asks for, rows that are kept, and what goes on after workers died."""

from __future__ import annotations

import http.client
import os
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from clusters import environment
from codegen.test_background import toy

from ctr_nlp import Load, table_i_robot
from ctr_nlp.cli.commands.new import template
from ctr_nlp.cli.main import main
from ctr_nlp.exceptions import LoadError, OptionError, OutputError
from ctr_nlp.solvers.frame.program import Program
from ctr_nlp.studies.grid.case import CASE_DONE, CASE_FAILED, CASE_LATE, CASE_LOST, Case, row_without_plan
from ctr_nlp.studies.grid.results import Results
from ctr_nlp.studies.grid.study_file import Study
from ctr_nlp.studies.workers.batches import FIRST_BATCH_CASES, MAX_WORKER_DEATHS, MIN_BATCH_S, Batches
from ctr_nlp.studies.workers.clients import local_client
from ctr_nlp.studies.workers.running import StudyProgress, run_study

pytest.importorskip("distributed", reason="the extra `study` is not installed")

SMALL = {
    "problems": {"names": ["arc"]},
    "frames": 4,
    "models": "dominant",
    "settings": {"seed": [0, 1, 2, 3]},
}


def study(told=SMALL, folder="."):
    return Study.from_dict(told, folder)


class Deadly(Case):
    """A case whose worker dies of it."""

    def row(self, keep=None):
        os._exit(1)


class Endless(Case):
    """A case that takes longer than anybody waits; its problem may be a file in which its tries are told."""

    def row(self, keep=None):
        if os.path.isabs(self.problem):
            with open(self.problem, "a") as told:
                told.write("begun\n")
        time.sleep(60)


class Sleepy(Case):
    """A case that takes a while and plans nothing."""

    def row(self, keep=None):
        time.sleep(0.4)
        return self.columns | {"status": CASE_DONE, "process_s": 0.4}


def made(kind, case):
    return kind(**{name: getattr(case, name) for name in Case.__dataclass_fields__})


class Compiling(Case):
    """A case that tells whether what it solves runs compiled; its program is like no other one's."""

    def row(self, keep=None):
        return self.columns | {
            "status": CASE_DONE,
            "process_s": 0.0,
            "compiled": Program(toy(1.0 + self.frames)).compiled,
        }


@pytest.fixture
def cold(tmp_path, monkeypatch):
    """A cache in which nothing is, and a compiler that takes 4 s a program; compiling as users have it."""
    real, script = shutil.which("cc") or shutil.which("gcc"), tmp_path / "compiler"
    if real is None:
        pytest.skip("no C compiler")
    script.write_text(f'#!/bin/sh\ncase " $* " in *" -E "*) ;; *) sleep 4;; esac\nexec {real} "$@"\n')
    script.chmod(0o755)
    monkeypatch.setenv("CC", str(script))
    monkeypatch.setenv("CTR_NLP_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("CTR_NLP_COMPILE", raising=False)


@pytest.fixture(scope="module")
def client():
    with local_client(2) as found:
        yield found


def test_a_study_is_every_combination(tmp_path):
    (tmp_path / "r.toml").write_text(table_i_robot().to_toml())
    (tmp_path / "airways").mkdir()
    rows = "".join(f"{0.001 * z * z},0,{z}\n" for z in range(0, 81, 4))
    (tmp_path / "airways" / "a.csv").write_text(f"x_mm,y_mm,z_mm\n{rows}")
    told = {
        "problems": {"names": ["cos", "line"], "folder": "airways", "synthetic": 2},
        "robots": {"files": ["r.toml"], "drawn": {"of": "r.toml", "count": 3, "seed": 1}},
        "models": ["dominant", "elastic"],
        "methods": "horizon",
        "sample": {"method": "sobol", "count": 4, "ranges": {"stability_margin": [0.1, 0.5]}},
    }
    found = study(told, tmp_path)
    assert len(found) == 5 * 4 * 2 * 4
    assert len({case.digest for case in found.cases}) == len(found)
    margins = {dict(case.settings)["stability_margin"] for case in found.cases}
    assert len(margins) == 4
    assert all(0.1 <= each <= 0.5 for each in margins)
    robots = {case.robot for case in found.cases}
    assert len(robots) == 4
    drawn = next(case for case in found.cases if case.robot_name == "r 1").load_problem().robot
    assert drawn.tubes[0].curvature != table_i_robot().tubes[0].curvature
    assert drawn.tolerances == table_i_robot().tolerances


@pytest.mark.parametrize(("name", "count"), [("study", 4 * 2), ("survival", 100 * 5)])
def test_templates_are_studies(name, count, tmp_path):
    (tmp_path / "s.toml").write_text(template(f"{name}.toml"), encoding="utf-8")
    found = Study.from_toml(tmp_path / "s.toml")
    assert len(found) == count
    assert found.report == (None if name == "study" else name)


def test_each_problem_has_draws_of_its_own_that_all_its_plans_share():
    told = {"problems": {"names": ["arc", "cos"]}, "draws": 2, "seed": 7, "settings": {"seed": [0, 1]}}
    assert [(case.problem, case.seed) for case in study(told).cases] == [
        *[("arc", 7)] * 2,
        *[("cos", 8)] * 2,
    ]


def test_a_study_may_leave_walls_out():
    told = SMALL | {"problems": {"names": ["bronchus"]}}
    assert study(told).cases[0].load_problem().lumen is not None
    assert study(told | {"walls": False}).cases[0].load_problem().lumen is None


def test_one_plan_is_made_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = 'frames = 4\nmethods = ["joint", "two-stage"]\nmodels = "elastic"\n[problems]\nnames = ["arc"]\n'
    (tmp_path / "s.toml").write_text(text)
    good, bad = Study.from_toml("s.toml").cases
    assert main(["study", "s.toml", "--only", good.digest[:10]]) == 0
    assert f"digest: {good.digest}" in capsys.readouterr().out
    assert main(["study", "s.toml", "--only", bad.digest]) == 2
    assert "two-stage" in capsys.readouterr().err
    assert main(["study", "s.toml", "--only", "x"]) == 2
    assert "--only x matches 0 plans" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["s.toml"]


def test_a_digest_changes_with_all_that_a_row_depends_on(tmp_path):
    case = study().cases[0]
    for change in (
        {"frames": 5},
        {"model": "elastic"},
        {"draws": 3},
        {"settings": (("seed", 9),)},
        {"content": "x"},
    ):
        assert replace(case, **change).digest != case.digest
    assert replace(case).digest == case.digest


def test_robots_bear_loads_of_files(tmp_path):
    (tmp_path / "push.toml").write_text("force = [0.0, 0.05, 0.0]\n")
    told = SMALL | {"settings": {}, "models": "elastic", "loads": ["none", "push.toml"], "youngs_modulus": 60_000}
    free, pushed = study(told, tmp_path).cases
    assert (free.columns["load"], pushed.columns["load"]) == ("none", "push")
    assert free.digest != pushed.digest
    plan = pushed.plan_motion(pushed.load_problem())
    assert plan.complete
    assert plan.evaluated_load == Load(force=(0.0, 0.05, 0.0))
    assert free.plan_motion(free.load_problem()).evaluated_load is None
    assert pushed.row()["status"] == CASE_DONE


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({}, "has no cases"),
        ({"problem": {}}, "key 'problem' is unknown"),
        ({"problems": {"names": ["cosine"]}}, "cosine"),
        ({"problems": {"folder": "nowhere"}}, "no centreline files"),
        ({"problems": {"files": ["nowhere.csv"]}}, "cannot be read"),
        (SMALL | {"models": "rigid"}, "rigid"),
        (SMALL | {"methods": ["fast"]}, "fast"),
        (SMALL | {"settings": {"margin": [1]}}, "key 'margin' is unknown"),
        (SMALL | {"settings": {"stability_margin": [2.0]}}, "stability_margin"),
        (SMALL | {"sample": {"count": 2, "ranges": {"seed": [3, 1]}}}, "range of seed"),
        (SMALL | {"sample": {"count": 2, "ranges": {"seed": [1, 3]}}}, "both listed and sampled"),
        (SMALL | {"robots": {"drawn": {"count": 2}}}, "need of"),
        (SMALL | {"settings": {"seed": [1, 1]}}, "cases twice"),
        (SMALL | {"frames": 0}, "frames of a study"),
        (SMALL | {"walls": "no"}, "walls of a study"),
        (SMALL | {"report": "fate"}, "fate"),
        (SMALL | {"measures": ["weight"]}, "weight"),
        (SMALL | {"ways": [{}]}, "models of a study stands beside"),
        ({"problems": {"names": ["arc"]}, "ways": [{"method": "joint"}]}, "key 'method' is unknown"),
    ],
)
def test_what_a_study_cannot_be_is_refused(told, message, tmp_path):
    with pytest.raises(OptionError, match=message):
        study(told, tmp_path)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"models": "elastic", "loads": ["nowhere.toml"]}, "nowhere.toml"),
        ({"models": "dominant", "loads": ["push.toml"]}, "a load does not go with the dominant model"),
        ({"loads": [3]}, "a load of a study is 3"),
        ({"youngs_modulus": 60}, "youngs_modulus of a robot is 60; .* 60000 MPa"),
    ],
)
def test_loads_that_no_robot_can_bear_are_refused(told, message, tmp_path):
    (tmp_path / "push.toml").write_text("force = [0.0, 0.05, 0.0]\n")
    with pytest.raises((LoadError, OptionError), match=message):
        study(SMALL | told, tmp_path)


def test_rows_are_read_back_whatever_columns_they_have(tmp_path):
    results = Results(tmp_path)
    assert results.read_digests() == set()
    with pytest.raises(OptionError, match="holds no rows"):
        results.frame()
    results.add([{"digest": "b", "e3": 1, "status": CASE_DONE}])
    results.add(
        [{"digest": "a", "e3": 0.5, "status": CASE_DONE, "more": "x"}, {"digest": "c", "status": CASE_FAILED}]
    )
    frame = results.frame()
    assert frame["digest"].tolist() == ["a", "b", "c"]
    assert frame["e3"].tolist()[:2] == [0.5, 1.0]
    assert frame["e3"].isna().tolist() == [False, False, True]
    assert results.read_digests() == {"a", "b", "c"}


def test_a_file_that_was_not_written_whole_is_no_row(tmp_path):
    results = Results(tmp_path)
    results.add([{"digest": "a"}])
    (tmp_path / "rows" / "x.partial").write_bytes(b"half")
    (tmp_path / "rows" / ".x-00.parquet").write_bytes(b"half")
    assert results.read_digests() == {"a"}


def test_rows_that_cannot_be_written_are_one_clear_error(tmp_path):
    (tmp_path / "rows").write_text("a file of the user's")
    with pytest.raises(OutputError, match="cannot be written"):
        Results(tmp_path).add([{"digest": "a"}])


def test_batches_grow_to_what_is_worth_a_task():
    cases = study(SMALL | {"settings": {"seed": list(range(100))}}).cases
    batches = Batches.of(cases)
    first = batches.next()
    assert len(first) == FIRST_BATCH_CASES
    batches.record_duration(first, FIRST_BATCH_CASES * MIN_BATCH_S / 20)
    assert len(batches.next()) == 20
    batches.isolated_cases.append(cases[0])
    assert batches.next() == [cases[0]]
    left = 100 - FIRST_BATCH_CASES - 20
    while batches:
        left -= len(batches.next())
    assert left == 0


def test_a_study_is_done_once_and_goes_on_where_it_was(client, tmp_path):
    few, told = study(SMALL | {"settings": {"seed": [0, 1]}}), []
    assert run_study(few, tmp_path, client).done == 2
    before = Results(tmp_path).frame()
    progress = run_study(study(), tmp_path, client, callback=lambda one: told.append(one.done), keep_plans=True)
    assert (progress.done_before, progress.done, progress.failed, progress.workers) == (2, 4, 0, 2)
    assert told[0] == 2
    assert told[-1] == 4
    frame = Results(tmp_path).frame()
    assert len(frame) == len(frame["digest"].unique()) == 4
    assert frame["complete"].all()
    assert frame["e3"].max() - frame["e3"].min() < 1e-3
    kept = frame[frame["digest"].isin(before["digest"])].reset_index(drop=True)
    assert kept["process_s"].tolist() == before["process_s"].tolist()
    assert len(list((tmp_path / "plans").glob("*.npz"))) == 2


def test_progress_says_how_many_plans_are_made_at_a_time():
    waiting = StudyProgress(total=4, done_before=0)
    assert waiting.workers_in_words == ""  # not counted yet
    assert replace(waiting, workers=0).workers_in_words == "no worker is there"
    assert replace(waiting, workers=2).workers_in_words == "2 plans at a time"


def test_a_second_study_in_the_folder_is_refused_while_the_first_is_at_work(client, tmp_path):
    told = []

    def second(progress):
        with pytest.raises(OutputError, match="another study is at work in") as refused:
            run_study(study(), tmp_path, client)
        told.append(str(refused.value))

    assert run_study(study(), tmp_path, client, callback=second).done == 4
    assert told
    assert len(Results(tmp_path).frame()) == 4
    assert run_study(study(), tmp_path, client).done_before == 4


def test_the_command_waits_for_no_dead_study_and_refuses_beside_one_at_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    text = 'frames = 4\nmodels = "dominant"\n[problems]\nnames = ["arc"]\n[settings]\nseed = [{}]\n'
    (tmp_path / "first.toml").write_text(text.format("0"))
    (tmp_path / "second.toml").write_text(text.format("0, 1"))
    assert main(["study", "first.toml", "--workers", "1", "--out", "here"]) == 1
    capsys.readouterr()
    code = "import sys; from ctr_nlp.studies.grid.results import Results\n"
    code += "with Results('here').sole_writer(): print('at work', flush=True); sys.stdin.read()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], env=environment(), **pipes) as other:
        other.stdout.readline()
        assert main(["study", "second.toml", "--workers", "1", "--out", "here"]) == 2
        told = capsys.readouterr().err
        other.kill()
    assert told.startswith("error: another study is at work in here; ")
    assert told.count("\n") == 1
    assert (tmp_path / "here" / "study.toml").read_text() == text.format("0")
    assert main(["study", "second.toml", "--workers", "1", "--out", "here"]) == 1
    assert len(Results(tmp_path / "here").frame()) == 2


def test_a_failure_is_a_row_with_its_reason(client, tmp_path):
    told = SMALL | {"models": ["dominant", "elastic"], "methods": ["two-stage"]}
    progress = run_study(study(told), tmp_path, client)
    frame = Results(tmp_path).frame()
    assert progress.failed == 4
    failed = frame[frame["status"] == CASE_FAILED]
    assert set(failed["model"]) == {"elastic"}
    assert failed["reason"].str.len().min() > 10


@pytest.mark.slow
def test_what_kills_its_worker_or_never_ends_is_a_row_and_the_rest_is_done(client, tmp_path):
    cases = study().cases
    deadly, endless = made(Deadly, cases[0]), made(Endless, cases[1])
    spoiled = replace(study(), cases=(deadly, endless, *cases[2:]))
    progress = run_study(spoiled, tmp_path, client, patience=3.0)
    frame = Results(tmp_path).frame().set_index("digest")
    assert (progress.done, progress.failed) == (4, 2)
    client.wait_for_workers(2, timeout=60)  # the last one that died may still be beginning anew
    assert sum(client.nthreads().values()) == 2
    assert frame.loc[deadly.digest, "status"] == CASE_LOST
    assert frame.loc[deadly.digest, "reason"].startswith(
        f"{MAX_WORKER_DEATHS} workers died of it, one after the other: "
    )
    assert frame.loc[endless.digest, "status"] == CASE_LATE
    assert frame.loc[endless.digest, "reason"] == "it took longer than 3 s"
    assert (frame.loc[[case.digest for case in cases[2:]], "status"] == CASE_DONE).all()
    again = replace(study(), cases=(*cases[:1], endless, *cases[2:]))
    progress = run_study(again, tmp_path, client, patience=3.0)
    assert (progress.done_before, progress.done, progress.failed) == (3, 4, 0)


def test_a_case_that_takes_too_long_is_tried_once(client, tmp_path):
    tries = tmp_path / "tries"
    (endless,) = (made(Endless, case) for case in study(SMALL | {"settings": {"seed": [0]}}).cases)
    counted = replace(endless, problem=str(tries))
    run_study(replace(study(), cases=(counted,)), tmp_path / "out", client, patience=1.0)
    assert tries.read_text() == "begun\n"


def test_a_plan_that_cannot_be_written_ends_the_study_and_is_made_again(client, tmp_path):
    (tmp_path / "plans").write_text("in the way of the folder")
    with pytest.raises(OutputError, match="folder of plans cannot be made"):
        run_study(study(), tmp_path, client, keep_plans=True)
    assert Results(tmp_path).read_digests() == set()
    (tmp_path / "plans").unlink()
    blocked = tmp_path / "plans" / f"{study().cases[0].digest}.npz"
    blocked.mkdir(parents=True)
    with pytest.raises(OutputError, match="plan cannot be written"):
        run_study(study(), tmp_path, client, keep_plans=True)
    assert study().cases[0].digest not in Results(tmp_path).read_digests()
    blocked.rmdir()
    assert run_study(study(), tmp_path, client, keep_plans=True).done == 4
    assert len(Results(tmp_path).frame()) == len(list((tmp_path / "plans").glob("*.npz"))) == 4


def test_a_worker_keeps_little_of_what_it_has_done(client, tmp_path):
    cases = study(SMALL | {"settings": {"seed": list(range(12))}}).cases
    run_study(replace(study(), cases=tuple(made(Sleepy, case) for case in cases)), tmp_path, client)
    for profiles, log in client.run(kept).values():
        assert profiles == 0
        assert log <= 100


def kept(dask_worker):
    """Trees of a worker's profile, one a second, and events of its log, which hold cases and rows, at most."""
    return len(dask_worker.profile_history), dask_worker.state.stimulus_log.maxlen


@pytest.mark.parametrize(
    ("headers", "expected"),
    [
        ({}, 200),
        ({"Host": "example.com"}, 403),
        ({"Origin": "http://example.com"}, 403),
    ],
)
def test_the_clusters_page_answers_no_other_page(client, headers, expected):
    address = re.search(r"127.0.0.1:\d+", client.dashboard_link)[0]
    link = http.client.HTTPConnection(address, timeout=30)
    link.request("GET", "/health", headers=headers)
    assert link.getresponse().status == expected
    link.close()


@pytest.mark.slow
def test_plans_wait_for_compiled_programs_and_are_not_late_for_it(cold, tmp_path):
    (case,) = study(SMALL | {"settings": {"seed": [0]}}).cases
    compiling = replace(study(), cases=(made(Compiling, case),))
    with local_client(1) as client:
        progress = run_study(compiling, tmp_path / "out", client, patience=3.0)
    assert (progress.done, progress.failed) == (1, 0)
    assert Results(tmp_path / "out").frame()["compiled"].tolist() == [True]


def test_a_stop_keeps_what_is_done(client, tmp_path):
    asked = []

    def stop():
        asked.append(1)
        return True

    progress = run_study(study(SMALL | {"settings": {"seed": list(range(60))}}), tmp_path, client, stop=stop)
    assert asked == [1]
    assert progress.done < 60
    assert len(Results(tmp_path).read_digests()) == progress.done


def test_a_lost_row_has_the_columns_of_its_case():
    case = study().cases[0]
    assert row_without_plan(case, CASE_LATE, "why", 3.0) == case.columns | {
        "status": CASE_LATE,
        "reason": "why",
        "process_s": 3.0,
    }


def test_the_command_does_a_study_and_tells_it_by_a_column(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "s.toml").write_text(
        'frames = 4\nmodels = "dominant"\n[problems]\nnames = ["arc"]\n[settings]\nseed = [0, 1]\n'
    )
    assert main(["study", "s.toml", "--workers", "1", "--out", "here"]) == 1
    assert "rows of all plans; 0 from earlier runs, 0 failed" in capsys.readouterr().out
    assert main(["study", "s.toml", "--by", "set_seed", "--page", "--out", "here"]) == 0
    told = capsys.readouterr().out
    assert "plans by set_seed" in told
    assert "plans of the largest e3" in told
    assert "arc, its own, " in (tmp_path / "here" / "worst.html").read_text()
    assert (tmp_path / "here" / "by.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "here" / "study.toml").read_text() == (tmp_path / "s.toml").read_text()
    assert main(["study", "s.toml", "--by", "colour", "--out", "here"]) == 2
    assert "colour is no column" in capsys.readouterr().err
    (tmp_path / "bad.toml").write_text("frames = 4\n")
    assert main(["study", "bad.toml", "--out", "no"]) == 2
    assert "study bad.toml: study 'study' has no cases" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
