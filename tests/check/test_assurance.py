"""The page on hazards is made from the tests, and a hazard without a test is an error."""

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROJECT = {"requires-python": ">=3.10", "dependencies": ["b>=2; python_version < '3.11'", "a>=1"]}


@pytest.fixture(scope="module")
def page():
    path = ROOT / "scripts" / "assurance" / "page.py"
    spec = importlib.util.spec_from_file_location("assurance_page", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_page_is_that_of_the_tests(page):
    assert page.main(["--check"]) == 0, "run `python scripts/assurance/page.py`"


def test_a_hazard_without_a_test_is_an_error(page):
    with pytest.raises(page.AssuranceError, match=r"no test shows .*: snap"):
        page.build_page({"snap": "A margin.", "fire": "None."}, {"fire": ["tests/a.py::b"]}, PROJECT)


def test_an_unknown_hazard_is_an_error(page):
    with pytest.raises(page.AssuranceError, match="does not have: flood"):
        page.build_page({}, {"flood": ["tests/a.py::b"]}, PROJECT)


def test_marked_tests_are_found(page, tmp_path):
    folder = tmp_path / "tests"
    folder.mkdir()
    (folder / "test_a.py").write_text('@pytest.mark.hazard("snap", "fire")\ndef test_b():\n    pass\n')
    found = page.find_tests(folder)
    assert found == {"snap": ["tests/test_a.py::test_b"], "fire": ["tests/test_a.py::test_b"]}
    text = page.build_page({"snap": "A margin.", "fire": "Water."}, found, PROJECT)
    assert "| snap | A margin. | `tests/test_a.py::test_b` |" in text
    assert "| a | >=1 |\n| b | >=2 where python_version < '3.11' |" in text
