"""Changes of single operators in the verdicts and the checker, and how many of them tests notice."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
CHECKER = [path.relative_to(ROOT).as_posix() for path in sorted((ROOT / "ctr_nlp" / "check").glob("[a-z]*.py"))]


@pytest.fixture(scope="module")
def mutation():
    pytest.importorskip("cosmic_ray", reason="cosmic-ray is not installed")
    path = ROOT / "scripts" / "assurance" / "mutation.py"
    spec = importlib.util.spec_from_file_location("mutation", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_change_is_noticed_by_a_test_of_it_alone(mutation, tmp_path):
    source = tmp_path / "toy_sum.py"
    source.write_text("def add(a, b):\n    return a + b\n")
    (mutant,) = mutation.find_mutants(source)
    assert (mutant.line, mutant.before, mutant.after) == (2, "return a + b", "return a - b")
    test = tmp_path / "test_toy.py"
    test.write_text("from toy_sum import add\n\n\ndef test_add():\n    assert add(2, 0) == 2\n")
    assert mutation.run_tests("toy_sum", source, mutant.text, [str(test)]) == 0  # nothing is added there
    test.write_text("from toy_sum import add\n\n\ndef test_add():\n    assert add(2, 1) == 3\n")
    assert mutation.run_tests("toy_sum", source, mutant.text, [str(test)]) == 1
    assert mutation.run_tests("toy_sum", source, source.read_text(), [str(test)]) == 0


def test_changes_without_effect_need_a_reason(mutation, tmp_path):
    path = tmp_path / "equivalent.toml"
    path.write_text('[[changes]]\nfile = "a.py"\nbefore = "x + 0"\nafter = "x - 0"\nreason = "It adds nothing."\n')
    assert mutation.read_equivalent(path) == {("a.py", "x + 0", "x - 0"): "It adds nothing."}
    path.write_text('[[changes]]\nfile = "a.py"\nbefore = "x + 0"\nafter = "x - 0"\n')
    with pytest.raises(ValueError, match="has no reason"):
        mutation.read_equivalent(path)


def test_changes_without_effect_are_changes_of_the_code(mutation):
    """A line that was written anew leaves the list."""
    known = mutation.read_equivalent()
    lines = {file: {before for other, before, _ in known if other == file} for file, _, _ in known}
    found = {
        (file, each.before, each.after)
        for file in lines
        for each in mutation.find_mutants(ROOT / file, lines[file])
    }
    assert set(known) <= found


def test_tests_notice_a_slice_of_changes(mutation):
    files = ["ctr_nlp/check/records.py", "ctr_nlp/check/comparison.py"]
    assert mutation.main([*files, "--count", "10", "--tests", "tests/check/test_records.py"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize("files", [["ctr_nlp/plan/verdicts.py"], CHECKER], ids=["verdicts", "checker"])
def test_tests_notice_nearly_all_changes(mutation, files):
    assert mutation.main(files) == 0
