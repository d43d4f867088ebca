"""Output folders: a run replaces what runs wrote, whole, whatever happens to it, and nothing of the user's."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from ctr_nlp.cli.output import folder as output
from ctr_nlp.cli.output.file import MAX_PATH_COMPONENT_BYTES, check_file, path_component, write_text
from ctr_nlp.cli.output.folder import check_folder, output_folder, results_folder
from ctr_nlp.cli.output.manifest import MARK, STANDARD
from ctr_nlp.exceptions import OutputError
from ctr_nlp.support.folder_lock import lock_folder

unix = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork and flock")
PLAN = {"plan.npz": "first", "errors.csv": "first", "shapes.png": "first"}


def run(folder: Path, files: dict[str, str], kind: str = "plan", interrupted: bool = False) -> None:
    """A run of a program that solves nothing."""
    check_folder(folder, kind, next((folder / name for name in files if name.endswith(".gif")), None))
    publish(results_folder(folder, interrupted), files, kind)


def publish(
    folder: Path, files: dict[str, str], kind: str = "plan", meanwhile: Callable[[], object] = int
) -> None:
    """What a run does at its end, and meanwhile something else happens."""
    with output_folder(folder, kind) as staging:
        for name, text in files.items():
            (staging / name).parent.mkdir(parents=True, exist_ok=True)
            (staging / name).write_text(text)
        meanwhile()


def contents(folder: Path) -> dict[str, str]:
    """All files but manifests, by their names relative to folder."""
    paths = (path for path in folder.rglob("*") if path.is_file() and path.name != MARK)
    return {path.relative_to(folder).as_posix(): path.read_text() for path in paths}


# names


@given(st.text())
def test_any_name_becomes_one_safe_component(name):
    found = path_component(name)
    assert 0 < len(found.encode()) <= MAX_PATH_COMPONENT_BYTES
    assert (Path("runs") / found).parts == ("runs", found)
    assert found[0] not in ".-~ "
    assert found[-1] not in ". "
    assert not set(found) & set('/\\:*?"<>|\0\n')
    assert found.isprintable()
    assert found.split(".")[0].upper() not in {"CON", "PRN", "AUX", "NUL", "COM1", "LPT9"}


@pytest.mark.parametrize(
    "name",
    ["../../x", "/etc/passwd", "..", ".", "", "a/../b", "C:\\x", "nul.txt", "-rf", "x\n", "a" * 300, "\ud800"],
)
def test_unsafe_names_are_marked(name):
    assert "~" in path_component(name)
    assert path_component(path_component(name)) != path_component(name)


@pytest.mark.parametrize(
    "name", ["bronchus", "arc-retraction", "synthetic 3", "LB1.a", "bronche_gauche_é", "気管"]
)
def test_safe_names_stay_as_they_are(name):
    assert path_component(name) == name


@given(st.lists(st.text(st.sampled_from("a/.\\ ~é"), max_size=6), min_size=2, max_size=20, unique=True))
def test_names_that_differ_stay_different(names):
    assert len({path_component(name) for name in names}) == len(names)


# what a run replaces, deletes and leaves alone


def test_a_run_replaces_and_deletes_what_the_last_one_wrote_and_nothing_else(tmp_path):
    out = tmp_path / "out"
    run(out, PLAN | {"deep/film.gif": "first"})
    (out / "notes.txt").write_text("mine")
    (out / "deep" / "own.txt").write_text("mine")
    run(out, {"plan.npz": "second", "stability.png": "second"})
    theirs = {"notes.txt": "mine", "deep/own.txt": "mine"}
    assert contents(out) == {"plan.npz": "second", "stability.png": "second"} | theirs
    assert os.listdir(tmp_path) == ["out"]
    run(out, PLAN, kind="plan")
    assert contents(out) == PLAN | theirs


def test_a_folder_that_only_a_film_needed_goes_with_it(tmp_path):
    run(tmp_path, {"deep/er/film.gif": "a"})
    run(tmp_path, {"plan.npz": "b"})
    assert set(os.listdir(tmp_path)) == {MARK, "plan.npz"}


def test_runs_of_other_kinds_keep_to_their_own_files(tmp_path):
    run(tmp_path, PLAN)
    run(tmp_path, {"report.html": "page"}, kind="report")
    run(tmp_path, {}, kind="play")
    assert contents(tmp_path) == PLAN | {"report.html": "page"}
    run(tmp_path, {"tracking.csv": "played"}, kind="play")
    run(tmp_path, {}, kind="force")
    assert contents(tmp_path) == PLAN | {"report.html": "page", "tracking.csv": "played"}


def test_a_new_plan_deletes_the_page_of_the_old_one(tmp_path):
    run(tmp_path, PLAN)
    run(tmp_path, {"report.html": "page"}, kind="report")
    run(tmp_path, {"plan.npz": "second"})
    assert contents(tmp_path) == {"plan.npz": "second"}


def test_the_manifest_tells_what_was_written(tmp_path):
    run(tmp_path, PLAN)
    data = json.loads((tmp_path / MARK).read_text())
    assert data["format"] == 1
    assert set(data["files"]) == set(PLAN)
    assert {(one["size"], one["kind"]) for one in data["files"].values()} == {(5, "plan")}
    assert {len(one["sha256"]) for one in data["files"].values()} == {64}


@pytest.mark.parametrize("name", ["plan.npz", "summary.json", "clearance.png"])
@pytest.mark.parametrize("how", ["new", "changed", "link", "folder"])
def test_a_standard_file_of_the_user_s_is_refused_early_by_name(tmp_path, name, how):
    run(tmp_path, {"plan.npz": "first"} | ({name: "first"} if how == "changed" else {}))
    (tmp_path / name).unlink(missing_ok=True)
    if how == "link":
        (tmp_path / name).symlink_to("elsewhere")
    elif how == "folder":
        (tmp_path / name).mkdir()
    else:
        (tmp_path / name).write_text("mine!")
    with pytest.raises(OutputError, match=f"{name} is in the way.*--out"):
        check_folder(tmp_path, "plan")
    assert os.path.lexists(tmp_path / name)


def test_a_film_over_a_file_of_the_user_s_is_refused_early(tmp_path):
    run(tmp_path, PLAN)
    (tmp_path / "holiday.gif").write_text("mine")
    with pytest.raises(OutputError, match=r"holiday\.gif is in the way"):
        check_folder(tmp_path, "plan", tmp_path / "holiday.gif")
    check_folder(tmp_path, "plan", tmp_path.parent / "elsewhere.gif")


def test_what_comes_in_the_way_at_the_end_sends_results_into_a_folder_of_their_own(tmp_path):
    out = tmp_path / "out"
    run(out, PLAN)
    for number in (1, 2):
        with pytest.raises(OutputError, match=rf"errors\.csv is in the way.*results are in .*out-kept-{number}$"):
            publish(out, dict.fromkeys(PLAN, "second"), meanwhile=lambda: (out / "errors.csv").write_text("mine"))
        assert contents(out) == PLAN | {"errors.csv": "mine"}
        assert contents(tmp_path / f"out-kept-{number}") == dict.fromkeys(PLAN, "second")
    run(tmp_path / "out-kept-1", PLAN)
    assert contents(tmp_path / "out-kept-1") == PLAN


@pytest.mark.parametrize("what", ["file", "foreign folder", "link"])
def test_a_folder_that_turns_into_something_else_loses_no_results(tmp_path, what):
    out = tmp_path / "out"
    check_folder(out, "plan")
    if what == "file":
        out.write_text("mine")
    elif what == "link":
        (tmp_path / "mine").mkdir()
        out.symlink_to("mine")
    else:
        run(out / "deep", {"a": "mine"})
        (out / "own.txt").write_text("mine")
    before = contents(tmp_path)
    with pytest.raises(OutputError, match=r"results are in .*out-kept-1"):
        publish(out, {"plan.npz": "solved"})
    assert contents(tmp_path) == before | {"out-kept-1/plan.npz": "solved"}


def test_nothing_is_written_through_links(tmp_path):
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    run(out, {"deep/film.gif": "first"})
    os.replace(out / "deep", elsewhere)
    (out / "deep").symlink_to(elsewhere)
    run(out, {"plan.npz": "second"})
    assert contents(elsewhere) == {"film.gif": "first"}
    with pytest.raises(OutputError, match="deep is in the way"):
        publish(out, {"deep/film.gif": "third"})
    assert contents(elsewhere) == {"film.gif": "first"}


def test_an_interrupted_run_goes_beside(tmp_path):
    out = tmp_path / "out"
    run(out, {"plan.npz": "half"}, interrupted=True)
    assert contents(out) == {"interrupted/plan.npz": "half"}
    run(out, PLAN)
    run(out, {"plan.npz": "third"}, interrupted=True)
    assert contents(out) == PLAN | {"interrupted/plan.npz": "third"}
    (out / "interrupted" / "plan.npz").write_text("mine")
    with pytest.raises(OutputError, match=r"results are in .*interrupted-kept-1"):
        run(out, {"plan.npz": "fourth"}, interrupted=True)
    assert contents(out / "interrupted") == {"plan.npz": "mine"}
    run(out, {"plan.npz": "fifth"})


@pytest.mark.parametrize("mark", ["", "Written by ctr_nlp, which replaces this folder whole.\n"])
def test_in_a_folder_of_the_version_before_standard_files_are_ours(tmp_path, mark):
    for name in (MARK, "plan.npz", "stability.png", "film.gif", "journal.jsonl"):
        (tmp_path / name).write_text(mark)
    run(tmp_path, {"plan.npz": "second"})
    assert contents(tmp_path) == {"plan.npz": "second", "film.gif": mark, "journal.jsonl": mark}
    assert set(json.loads((tmp_path / MARK).read_text())["files"]) == {"plan.npz"}


def test_standard_names_of_the_seed_s_study_are_those_it_writes():
    from paper import SECTIONS  # not in the programs below, which import this file

    pictures = {f"{name}.png" for name, section in SECTIONS.items() if section.draw is not None}
    assert set(STANDARD["seed"]) == {"seed.md"} | {f"{name}.csv" for name in SECTIONS} | pictures


# manifests that nobody of ours wrote

ENTRY = {"kind": "plan", "size": 4, "sha256": "0" * 64}


def manifest(name="plan.npz", pending=None):
    return json.dumps({"format": 1, "files": {name: ENTRY}} | ({"pending": pending} if pending else {}))


def pending(staging=".ctr_nlp-00000000", name="plan.npz", superseded="errors.csv"):
    return manifest(pending={"staging": staging, "files": {name: ENTRY}, "superseded": [superseded]})


@pytest.mark.parametrize(
    "text",
    [
        '{"format": 1, "files": {"plan.npz"',
        '{"format": 2, "files": {}}',
        '{"files": {}}',
        '{"format": 1, "files": []}',
        '{"format": 1, "files": {"plan.npz": {"size": 4}}}',
        *map(manifest, ("../own.txt", "/own.txt", "", ".", "a/../../own.txt")),
        *(pending(staging) for staging in ("..", "../out", "")),
        pending(name="../own.txt"),
        pending(superseded="../own.txt"),
    ],
)
def test_a_manifest_that_cannot_be_understood_is_refused(tmp_path, text):
    out = tmp_path / "out"
    run(out, PLAN)
    (tmp_path / "own.txt").write_text("mine")
    (out / MARK).write_text(text)
    with pytest.raises(OutputError, match=r"manifest .* cannot be read"):
        check_folder(out, "plan")
    assert contents(tmp_path) == {"own.txt": "mine"} | {f"out/{name}": text for name, text in PLAN.items()}
    assert (out / MARK).read_text() == text


# what goes wrong while writing


def full(*_):
    raise OSError(28, "No space left on device")


def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    out = tmp_path / "out"
    run(out, PLAN)
    for name in ("replace", "fsync"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, full)
            with pytest.raises(OutputError, match="No space left"):
                run(out, {"plan.npz": "second"})
        assert contents(tmp_path) == {f"out/{name}": text for name, text in PLAN.items()}
    with pytest.raises(OutputError, match="No space left"):
        publish(tmp_path / "new", {"plan.npz": "second"}, meanwhile=full)
    assert os.listdir(tmp_path) == ["out"]


@pytest.mark.parametrize("step", range(6))
def test_a_write_that_fails_on_the_way_loses_nothing(tmp_path, monkeypatch, step):
    """Whichever move fails, each file is one of the two runs', and where the old one stays the new one is kept."""
    out = tmp_path / "out"
    run(out, PLAN | {"stability.png": "first"})
    replace, calls = os.replace, []

    def failing(source, target):
        calls.append(target)
        if len(calls) == step + 1:
            raise OSError(5, "Input/output error")
        replace(source, target)

    second = dict.fromkeys(PLAN, "second")
    monkeypatch.setattr(os, "replace", failing)
    with suppress(OutputError):
        run(out, second)
    monkeypatch.setattr(os, "replace", replace)
    check_folder(out, "plan")
    found = contents(tmp_path)
    for name in PLAN:
        assert found[f"out/{name}"] in ("first", "second")
        assert "second" in (found[f"out/{name}"], found.get(f"out-kept-1/{name}"))
    whole = all(found[f"out/{name}"] == "second" for name in PLAN)
    assert whole or found["out/stability.png"] == "first"
    run(out, {"plan.npz": "third"})
    assert contents(out) == {"plan.npz": "third"}


def test_a_read_only_folder_is_refused_early(tmp_path):
    run(tmp_path / "out", PLAN)
    (tmp_path / "out").chmod(0o500)
    try:
        if os.access(tmp_path / "out", os.W_OK):
            pytest.skip("this user may write anywhere")
        with pytest.raises(OutputError, match="cannot be written"):
            check_folder(tmp_path / "out", "plan")
    finally:
        (tmp_path / "out").chmod(0o700)
    assert contents(tmp_path / "out") == PLAN


@unix
def test_ctrl_c_twice_while_publishing_is_too_late(tmp_path, monkeypatch):
    finish = output._finish

    def interrupted(folder):
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
        return finish(folder)

    monkeypatch.setattr(output, "_finish", interrupted)
    run(tmp_path, PLAN)
    assert contents(tmp_path) == PLAN


# runs that are killed, and several at once


def test_staging_folders_of_the_dead_go_and_those_of_the_living_stay(tmp_path):
    dead, living, other = (tmp_path / f"{MARK}-{end}" for end in ("00000001", "00000002", "mine"))
    run(tmp_path, PLAN)
    for folder in (dead, living, other):
        folder.mkdir()
        (folder / "plan.npz").write_text("half")
    with lock_folder(living):
        check_folder(tmp_path, "plan")
        run(tmp_path, PLAN)
        assert not dead.exists()
        assert living.is_dir()
    run(tmp_path, PLAN)
    assert not living.exists()
    assert other.is_dir()


def test_what_a_killed_first_run_left_is_not_taken_for_the_user_s(tmp_path):
    (tmp_path / f"{MARK}-00000001").mkdir()
    with lock_folder(tmp_path / f"{MARK}-00000001"):
        run(tmp_path, PLAN)
    assert contents(tmp_path) == PLAN


def test_a_second_run_waits_for_the_first_to_publish(tmp_path, monkeypatch):
    run(tmp_path, PLAN)
    with lock_folder(tmp_path):
        second = threading.Thread(target=run, args=(tmp_path, {"plan.npz": "second"}))
        second.start()
        second.join(0.3)
        assert second.is_alive()
        assert contents(tmp_path) == PLAN
    second.join()
    assert contents(tmp_path) == {"plan.npz": "second"}


def test_a_run_that_waits_in_vain_keeps_its_results(tmp_path, monkeypatch):
    out = tmp_path / "out"
    monkeypatch.setattr(output, "PUBLISH_LOCK_TIMEOUT_S", 0.05)
    kept = r"another run is writing.*results are in .*out-kept-1"
    with ExitStack() as held, pytest.raises(OutputError, match=kept):
        publish(out, {"plan.npz": "solved"}, meanwhile=lambda: held.enter_context(lock_folder(out)))
    assert contents(tmp_path) == {"out-kept-1/plan.npz": "solved"}


def test_runs_side_by_side_never_mix(tmp_path):
    def repeat(name: str) -> None:
        for _ in range(10):
            run(tmp_path, dict.fromkeys(PLAN, name) | {name: name})

    threads = [threading.Thread(target=repeat, args=(name,)) for name in "abc"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    found = contents(tmp_path)
    assert len(set(found.values())) == 1
    assert set(found) == {*PLAN, found["plan.npz"]}


def test_a_run_that_publishes_while_another_looks_at_the_folder_is_not_in_its_way(tmp_path, monkeypatch):
    other = threading.Thread(target=publish, args=(tmp_path, PLAN))
    check = output._check

    def check_slowly(*arguments):
        monkeypatch.setattr(output, "read_manifest", read_slowly)
        check(*arguments)

    def read_slowly(folder, read=output.read_manifest):
        found = read(folder)
        if other.ident is None:
            other.start()
            other.join(0.5)
        return found

    monkeypatch.setattr(output, "_check", check_slowly)
    check_folder(tmp_path, "plan")
    other.join()
    assert contents(tmp_path) == PLAN


def test_what_a_run_tries_a_folder_with_may_be_tidied_away_by_another(tmp_path, monkeypatch):
    make = Path.mkdir

    def tidied(self):
        make(self)
        os.rmdir(self)

    monkeypatch.setattr(Path, "mkdir", tidied)
    check_folder(tmp_path, "plan")
    assert contents(tmp_path) == {}


KILLED = """
import os, sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_output import killed_at
killed_at(Path(sys.argv[2]), int(sys.argv[3]))
"""
STEPS = ("replace", "unlink", "rmdir", "mkdir", "fsync")
"""Calls of the system, those that change something, before each of which a run is killed in turn."""


def killed_at(root: Path, first: int) -> None:
    """For every step of a run kill one there; whatever was done until then, the next run leaves all in order."""
    for step in range(first, 10_000):
        out = root / str(step)
        run(out, PLAN | {"deep/film.gif": "first"})
        (out / "notes.txt").write_text("mine")
        child = os.fork()
        if child == 0:
            kill_before(step)
            run(out, {"plan.npz": "second", "errors.csv": "second", "stability.png": "second"})
            os._exit(0)
        _, status = os.waitpid(child, 0)
        check_folder(out, "plan")
        print(json.dumps({"killed": os.WIFSIGNALED(status), "files": contents(out), "all": os.listdir(out)}))
        if not os.WIFSIGNALED(status):
            assert status == 0
            return


def kill_before(step: int) -> None:
    """Kill this process before its call number step, from 0, of any of STEPS."""
    left = [step]

    def counted(name):
        before = getattr(os, name)

        def call(*arguments, **options):
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            left[0] -= 1
            return before(*arguments, **options)

        setattr(os, name, call)

    for name in STEPS:
        counted(name)


COUNTED = 15 if sys.version_info >= (3, 11) else 10
"""Steps of publishing that can be counted at least: before 3.11, pathlib held on to functions of its own."""


@unix
def test_a_run_killed_at_any_step_is_completed_or_undone_by_the_next(tmp_path):
    command = [sys.executable, "-c", KILLED, Path(__file__).parent, tmp_path, "0"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(found) > COUNTED
    assert [one["killed"] for one in found] == [True] * (len(found) - 1) + [False]
    old = PLAN | {"deep/film.gif": "first", "notes.txt": "mine"}
    new = {"plan.npz": "second", "errors.csv": "second", "stability.png": "second", "notes.txt": "mine"}
    states = [old, new]
    assert all(one["files"] in states for one in found)
    completed = [one["files"] == new for one in found]
    assert completed == sorted(completed)
    assert COUNTED // 3 < sum(completed) < len(found) - COUNTED // 3
    assert not any(name.startswith(f"{MARK}-") for one in found for name in one["all"])


REPEATED = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from test_output import run
for number in range(10_000):
    run(Path(sys.argv[2]), {"plan.npz": str(number) * 1000, "errors.csv": str(number) * 1000, f"{number}": "x"})
    print(number, flush=True)
"""


@unix
@pytest.mark.parametrize("count", [3, pytest.param(150, marks=pytest.mark.slow)])
def test_kill_9_at_random_moments_of_publishing_loses_nothing(tmp_path, count):
    moments = random.Random(0)
    (tmp_path / "out").mkdir()
    for _ in range(count):
        command = [sys.executable, "-c", REPEATED, Path(__file__).parent, tmp_path / "out"]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        (tmp_path / "out" / "notes.txt").write_text("mine")
        time.sleep(moments.uniform(0, 0.05))
        process.kill()
        last = int(([line for line in process.communicate()[0].splitlines() if line] or ["0"])[-1])
        check_folder(tmp_path / "out", "plan")
        found = contents(tmp_path / "out")
        number = int(next(name for name in found if name.isdigit()))
        assert number >= last
        assert found == {
            "notes.txt": "mine",
            "plan.npz": str(number) * 1000,
            "errors.csv": str(number) * 1000,
            str(number): "x",
        }
        assert set(os.listdir(tmp_path / "out")) == {MARK, *found}


# a folder over a long life

NAMES = st.sampled_from(["plan.npz", "errors.csv", "stability.png", "deep/film.gif"])


class Life(RuleBasedStateMachine):
    """Runs, interruptions, and a user who adds, edits and deletes; the model is what must be in the folder."""

    @initialize()
    def begin(self) -> None:
        self.room = tempfile.TemporaryDirectory()
        self.out = Path(self.room.name) / "out"
        run(self.out, {"plan.npz": "0"})
        self.ours, self.theirs, self.number = {"plan.npz": "0"}, dict[str, str](), 0
        self.beside: dict[str, str] = {}

    @rule(names=st.sets(NAMES, min_size=1))
    def solve(self, names: set[str]) -> None:
        self.number += 1
        files = dict.fromkeys(names, f"run {self.number}")
        in_the_way = (set(STANDARD["plan"]) | names) & set(self.theirs)
        if not in_the_way:
            run(self.out, files)
            self.ours = files
            return
        with pytest.raises(OutputError, match="|".join(map(re.escape, in_the_way))):
            run(self.out, files)

    @rule(names=st.sets(NAMES, min_size=1))
    def interrupt(self, names: set[str]) -> None:
        self.number += 1
        files = dict.fromkeys(names, f"interrupted {self.number}")
        with suppress(OutputError):
            run(self.out, files, interrupted=True)
            self.beside = files

    @rule(name=NAMES | st.sampled_from(["notes.txt", "film.gif"]))
    def edit(self, name: str) -> None:
        self.number += 1
        self.ours.pop(name, None)
        self.theirs[name] = f"user {self.number}"
        (self.out / name).parent.mkdir(exist_ok=True)
        (self.out / name).write_text(self.theirs[name])

    @rule(name=NAMES | st.sampled_from(["notes.txt", "film.gif"]))
    def delete(self, name: str) -> None:
        (self.out / name).unlink(missing_ok=True)
        self.ours.pop(name, None)
        self.theirs.pop(name, None)

    @rule(names=st.sets(NAMES, min_size=1), step=st.integers(0, 30))
    def die(self, names: set[str], step: int) -> None:
        """A run that is killed: whole or not at all, once the next one has looked at the folder."""
        self.number += 1
        files = dict.fromkeys(names, f"run {self.number}")
        child = os.fork()
        if child == 0:
            kill_before(step)
            with suppress(OutputError):
                run(self.out, files)
            os._exit(0)
        os.waitpid(child, 0)
        with suppress(OutputError):
            check_folder(self.out, "plan")
        if contents(self.out).get(min(names)) == f"run {self.number}":
            self.ours = files

    @invariant()
    def nothing_else_is_there(self) -> None:
        if hasattr(self, "out"):
            beside = {f"interrupted/{name}": text for name, text in self.beside.items()}
            assert contents(self.out) == self.ours | self.theirs | beside
            assert os.listdir(self.room.name) == ["out"]

    def teardown(self) -> None:
        if hasattr(self, "room"):
            self.room.cleanup()


TestLife = unix(pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")(Life.TestCase))
TestLife.settings = settings(max_examples=15, stateful_step_count=25, deadline=None)


# single files


def test_a_file_is_written_whole_and_beside_nothing_of_the_user_s(tmp_path, monkeypatch):
    (tmp_path / ".table.csv.partial").write_text("mine")
    write_text(tmp_path / "deep" / "table.csv", "a")
    write_text(tmp_path / "table.csv", "b")
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(OutputError, match="No space left"):
            write_text(tmp_path / "table.csv", "c")
    assert contents(tmp_path) == {".table.csv.partial": "mine", "deep/table.csv": "a", "table.csv": "b"}
    check_file(tmp_path / "table.csv", "b")
    with pytest.raises(OutputError, match="was not written by ctr-nlp"):
        check_file(tmp_path / "table.csv", "c")
