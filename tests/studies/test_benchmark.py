"""The benchmark's records, their comparison with a baseline, and the program around them; no times are judged."""

import json
import math
from types import SimpleNamespace

import pytest
from problems import named

from ctr_nlp.cli.studies import benchmark
from ctr_nlp.cli.studies.benchmark import main
from ctr_nlp.studies.benchmarks import RATIO, Record, horizons, regressions
from ctr_nlp.studies.benchmarks.frames import EVERY, REFERENCES, ROUNDS, race

# Regressions


def record(value, better="less", tolerance=0.5, name="figure"):
    return Record(name, value, "", better, tolerance)


@pytest.mark.parametrize(
    ("value", "better", "tolerance", "worse"),
    [
        (7.0, "less", 0.5, True),
        (6.0, "less", 0.5, False),
        (math.nextafter(6.0, 7), "less", 0.5, True),
        (1.0, "less", 0.5, False),
        (1.0, "more", 0.5, True),
        (2.0, "more", 0.5, False),
        (math.nextafter(2.0, 1), "more", 0.5, True),
        (9.0, "more", 0.5, False),
        (4.0, "less", 0.0, False),
        (math.nextafter(4.0, 5), "less", 0.0, True),
        (4.0, "more", 0.0, False),
        (math.nextafter(4.0, 3), "more", 0.0, True),
        (math.inf, "less", 0.5, True),
        (math.inf, "more", 0.5, False),
        (math.nan, "less", 0.5, True),
        (math.nan, "more", 0.5, True),
        (1e9, "less", None, False),
        (0.0, "more", None, False),
        (math.nan, "less", None, False),
    ],
)
def test_a_figure_counts_as_worse_beyond_its_tolerance_and_not_at_it(value, better, tolerance, worse):
    baseline = {"figure": 4.0}
    assert bool(regressions([record(value, better, tolerance)], baseline)) is worse


def test_figures_without_a_baseline_are_left_out_even_where_they_are_no_numbers():
    given = [record(math.nan, name="new"), record(100.0, name="old")]
    assert len(regressions(given, {"old": 4.0, "gone": 1.0})) == 1
    assert regressions(given, {}) == []
    assert regressions([], {"old": 4.0}) == []


def test_what_has_become_worse_is_told_in_the_order_of_the_records_with_both_values():
    given = [record(9.0, name="b"), record(4.0, name="fine"), record(1.0, "more", 0.25, "a")]
    told = regressions(given, {"a": 4.0, "b": 4.0, "fine": 4.0})
    assert told == [
        "b: 9, was 4; less is better and 50% is tolerated",
        "a: 1, was 4; more is better and 25% is tolerated",
    ]


def test_a_count_that_was_zero_may_not_grow():
    assert regressions([record(1.0, tolerance=0.0)], {"figure": 0.0})
    assert not regressions([record(0.0, tolerance=0.0)], {"figure": 0.0})


# The program

FIGURES = (
    Record("ratio", 4.0, "", "more", RATIO),
    Record("time", 7.0, "us", "less"),
    Record("failed", 0.0, "", "less", 0.0),
)


@pytest.fixture(autouse=True)
def baseline(tmp_path, monkeypatch):
    """Where the baseline is to be; nothing is there yet."""
    monkeypatch.setattr(benchmark, "BASELINE", tmp_path / "baseline.json")
    return benchmark.BASELINE


@pytest.fixture
def measured(monkeypatch):
    """The part horizons yields FIGURES and no longer measures; which problems it was asked for."""
    asked = []

    def part(named, chosen):
        asked.extend(chosen)
        yield from FIGURES

    monkeypatch.setitem(benchmark.PARTS, "horizons", part)
    return asked


def run(*arguments):
    return main(["--parts", "horizons", "--problems", "arc", *map(str, arguments)])


def write_baseline(**values):
    entries = [{"name": name, "value": value} for name, value in values.items()]
    benchmark.BASELINE.write_text(json.dumps(entries))


def small(monkeypatch):
    monkeypatch.setattr(benchmark, "named", lambda name, count=100: named(name, 4))
    monkeypatch.setattr(horizons, "REPEATS", 1)


def test_the_horizons_of_a_small_problem_are_measured_and_written(tmp_path, monkeypatch, capsys):
    small(monkeypatch)
    file = tmp_path / "records.json"
    assert run("--json", file) == 0
    records = [Record(**entry) for entry in json.loads(file.read_text(encoding="utf-8"))]
    names = [entry.name for entry in records]
    assert len(set(names)) == len(names)
    for entry in records:
        assert isinstance(entry.value, (int, float))
        assert math.isfinite(entry.value)
        assert entry.better in ("less", "more")
        assert entry.tolerance is None or entry.tolerance >= 0
    at = {entry.name: entry for entry in records}
    solvers = [f"{name}, {how}" for name in ("banded", "ipopt") for how in ("compiled", "interpreted")]
    for solver in solvers:
        assert at[f"arc, horizon, {solver}: solved"].value == 1
        assert at[f"arc, horizon, {solver}: time"].value > 0
        assert at[f"arc, horizon, {solver}: iterations"].value > 0
    both = [at[f"arc, horizon, banded, {how}: objective"].value for how in ("compiled", "interpreted")]
    assert both[0] == pytest.approx(both[1], rel=1e-6)
    for solver in set(solvers) - {"banded, compiled"}:
        ratio = at[f"arc, horizon: {solver} / banded, compiled"]
        assert ratio.value > 0
        assert (ratio.better, ratio.tolerance) == ("more", RATIO)
        mean = at[f"all problems, horizon: {solver} / banded, compiled, geometric mean"]
        assert mean.value == pytest.approx(ratio.value)
    out = capsys.readouterr().out
    assert all(name in out for name in names)
    assert f"wrote {file}" in out.replace("\n", "")


def test_what_is_written_serves_as_a_baseline_of_itself(measured, capsys):
    file = benchmark.BASELINE
    assert run("--json", file, "--check") == 0
    assert measured == ["arc"]
    assert json.loads(file.read_text())[0] == {
        "name": "ratio",
        "value": 4.0,
        "unit": "",
        "better": "more",
        "tolerance": RATIO,
    }
    assert "2 figures compared with baseline.json, 0 worse" in capsys.readouterr().out


def test_a_ratio_far_worse_than_the_baseline_ends_in_1_and_is_named(measured, capsys):
    write_baseline(ratio=40.0, time=1e-9, failed=0.0)
    assert run("--check") == 1
    out = capsys.readouterr().out
    assert "worse: ratio: 4, was 40; more is better" in out
    assert out.count("worse: ") == 1
    assert "2 figures compared with baseline.json, 1 worse" in out


def test_ratios_within_their_tolerance_and_unknown_ones_end_in_0(measured, capsys):
    write_baseline(ratio=6.0, other=1.0)
    assert run("--check") == 0
    assert "1 figures compared with baseline.json, 0 worse" in capsys.readouterr().out


def test_without_check_no_baseline_is_read(measured):
    write_baseline(ratio=40.0)
    assert run() == 0


def assert_refused(capsys, *words):
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("error: ")
    assert all(word in error for word in words)


@pytest.mark.parametrize(
    "content",
    [None, b"", b"{", b"\xff\xfe", b"7", b"[1]", b'{"ratio": 4}', b'[{"name": "ratio"}]', b"null"],
)
def test_a_baseline_that_cannot_be_read_ends_in_2_with_one_line(measured, capsys, content):
    if content is not None:
        benchmark.BASELINE.write_bytes(content)
    assert run("--check") == 2
    assert_refused(capsys, "baseline.json", "cannot be read", "--json writes one")


@pytest.mark.parametrize("value", ["null", '"4"', "[4]"])
def test_a_baseline_whose_values_are_no_numbers_ends_in_2_with_one_line(measured, capsys, value):
    text = f'[{{"name": "ratio", "value": {value}}}]'
    benchmark.BASELINE.write_text(text)
    assert run("--check") == 2
    assert_refused(capsys, "baseline.json")


@pytest.mark.parametrize("place", ["missing/records.json", "."])
def test_a_place_that_cannot_be_written_ends_in_2_with_one_line_before_anything_is_measured(
    measured, capsys, tmp_path, place
):
    assert run("--json", tmp_path / place) == 2
    assert measured == []
    assert_refused(capsys, str(tmp_path / place))


def test_without_a_compiler_nothing_is_measured(measured, monkeypatch, capsys, tmp_path):
    monkeypatch.setenv("CTR_NLP_COMPILE", "0")
    file = tmp_path / "records.json"
    assert run("--json", file) == 2
    assert measured == []
    assert not file.exists()
    assert_refused(capsys, "CTR_NLP_COMPILE is 0")


@pytest.mark.parametrize("arguments", [["--parts", "everything"], ["--problems", "spiral"], ["--json"]])
def test_names_that_do_not_exist_are_refused(arguments, capsys):
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "usage: ctr-nlp benchmark" in capsys.readouterr().err


def test_every_part_is_measured_by_default_and_in_the_order_asked_for(monkeypatch):
    asked = []
    for part in benchmark.PARTS:
        monkeypatch.setitem(benchmark.PARTS, part, lambda named, chosen, part=part: asked.append(part) or iter(()))
    assert main([]) == 0
    assert asked == ["start-up", "frames", "horizons", "elastic", "growth", "sizes"]
    assert main(["--parts", "sizes", "frames"]) == 0
    assert asked[6:] == ["sizes", "frames"]


def test_geometric_means_are_taken_of_the_same_ratio_over_problems(monkeypatch):
    ratios = iter((2.0, 8.0))

    def frames(problem):
        yield Record(f"{problem.name}, a frame: ipopt / sqp", next(ratios), "", "more", RATIO)
        yield Record(f"{problem.name}, a frame, sqp: median", 3.0, "us", "less")

    monkeypatch.setattr(benchmark, "frames", frames)
    *_, mean = benchmark.PARTS["frames"](lambda name: SimpleNamespace(name=name), ["cos", "arc", "bronchus"])
    assert mean == Record("all problems, a frame: ipopt / sqp, geometric mean", 4.0, "", "more", RATIO)


# The race of frames


def test_every_method_has_its_frames_and_sqp_solves_them_all():
    """The first frame is where all begin; the slow methods are asked once, for every EVERY-th."""
    problem = named("arc", 2 * EVERY + 2)
    times = race(problem)
    assert set(times) == {"sqp", "ipopt", *REFERENCES}
    for name, taken in times.items():
        count = 2 if name in REFERENCES else ROUNDS * (problem.frames - 1)
        assert len(taken.seconds) == len(taken.iterations) == count
        assert min(taken.iterations) >= 0
        assert sum(taken.iterations) > 0
        assert 0 <= taken.failed <= count
    assert times["sqp"].failed == 0
    assert times["ipopt"].failed == 0
