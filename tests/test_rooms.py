"""How the house is built: imports go downwards and never in circles, and nobody sets the
attributes of somebody else."""

from __future__ import annotations

import ast
import functools
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from ctr_nlp.models import KINEMATIC_MODELS

ROOT = Path(__file__).parents[1]

FEATURES = (
    "cli",
    "studies",
    "hardware",
    "tube_design",
    "identify",
    "loads",
    "view",
    "reference",
    "robust",
    "anatomy",
    "check",
)
"""From top to bottom: each may import those after it, and the core. A feature can be deleted without the core
noticing.
"""

CORE = ("planning", "plan", "solvers", "ocp", "models", "paths", "robot", "codegen")
"""From top to bottom: each may import those after it, and the ground; none imports a feature."""

GROUND = ("support", "exceptions", "typing")

ROOMS = (*FEATURES, *CORE, *GROUND)

OUTSIDE = {"cli", "__main__"}
"""What takes from the package itself, as users do: names, and its version."""

STRANGERS = {"hardware", "anatomy"}
"""Rooms that never import each other."""

MODELS = {name for name, model in KINEMATIC_MODELS.items() if type(model).__module__.startswith("ctr_nlp.")}
"""Names of the package's own models; other tests may have registered further ones."""
REGISTRY = "ctr_nlp/models/registry.py"

FOREIGN = {
    "restype": "ctypes has no other way to say what a function of a library returns",
    "writeable": "numpy has no other way to make an array read-only",
    "labelpad": "matplotlib's three-dimensional axes have no method for it",
    "computed_zorder": "matplotlib's three-dimensional axes have no method for it",
    "camera": "k3d's plots have no method for it",
    "choices": "argparse offers no other way to add to what an option may be",
    "complete": "shtab reads how an option is completed from its action",
    "total": "rich tells a task's total so",
    "serve": "viser has no option for what its WebSocket server may answer",
    **dict.fromkeys(
        (
            *("visible", "opacity", "position", "points", "colors", "value", "content", "label"),
            *("batched_positions", "batched_wxyzs", "batched_scales", "batched_colors"),
            *("up", "up_direction", "fov", "look_at"),
            *("color", "side", "wxyz", "disabled"),
        ),
        "viser's handles are changed by their attributes alone",
    ),
}
"""Attributes of other libraries' objects that may be set from outside, and why."""


@functools.cache
def _sources() -> dict[str, ast.Module]:
    """The syntax of every file of the library, by path."""
    paths = sorted((ROOT / "ctr_nlp").rglob("*.py"))
    return {path.relative_to(ROOT).as_posix(): ast.parse(path.read_text(encoding="utf-8")) for path in paths}


def _module(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def imports(sources: dict[str, ast.Module]) -> dict[str, set[str]]:
    """Module -> modules of the library that it imports anywhere in it: on top, in a function, for types only."""
    modules = {_module(path) for path in sources}
    found: dict[str, set[str]] = {}
    for path, tree in sources.items():
        named = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                named |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                base = node.module or ""
                if node.level:
                    package = path.split("/")[: -node.level]
                    base = ".".join([*package, *([node.module] if node.module else [])])
                submodules = {f"{base}.{alias.name}" for alias in node.names} & modules
                named |= submodules
                if len(submodules) < len(node.names):
                    named.add(base)
        found[_module(path)] = (named & modules) - {_module(path)}
    return found


def _reached(graph: dict[str, set[str]]) -> dict[str, set[str]]:
    """Module -> all that it needs, however far away."""
    reached: dict[str, set[str]] = {}
    for start in graph:
        seen: set[str] = set()
        ahead = list(graph[start])
        while ahead:
            module = ahead.pop()
            if module not in seen:
                seen.add(module)
                ahead += graph[module]
        reached[start] = seen
    return reached


def circles(graph: dict[str, set[str]]) -> Iterator[str]:
    """Every import that is part of a circle."""
    reached = _reached(graph)
    for module, imported in graph.items():
        for other in imported:
            if module in reached[other]:
                yield f"circle: {module} -> {other}"


def upward_arrows(graph: dict[str, set[str]]) -> Iterator[str]:
    """Every import of a room by one that lies below it or must not know it; the package itself is no room."""
    for module, imported in graph.items():
        for other in imported:
            if "." not in module or "." not in other:
                if other == "ctr_nlp" and not {*module.split(".")} & OUTSIDE:
                    yield f"upwards: {module} -> {other}"
                continue
            own, there = module.split(".")[1], other.split(".")[1]
            if own == "__main__":
                continue
            assert {own, there} <= set(ROOMS), f"{own} or {there} has no place in ROOMS"
            if ROOMS.index(there) < ROOMS.index(own) or (own != there and {own, there} <= STRANGERS):
                yield f"upwards: {module} -> {other}"


def _names(node: ast.AST) -> set[str]:
    """Texts in a constant or in a list of them."""
    parts = node.elts if isinstance(node, ast.Tuple | ast.List | ast.Set) else [node]
    return {part.value for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str)}


def compared_models(sources: dict[str, ast.Module]) -> Iterator[str]:
    """Every comparison with the name of a model outside their registry."""
    for path, tree in sources.items():
        if path == REGISTRY:
            continue
        for node in ast.walk(tree):
            operands: list[ast.AST] = []
            if isinstance(node, ast.Compare):
                left = [] if isinstance(node.left, ast.Tuple) else [node.left]  # a tuple is a key, not a name
                operands = [*left, *node.comparators]
            elif isinstance(node, ast.MatchValue):
                operands = [node.value]
            if any(_names(operand) & MODELS for operand in operands):
                yield f"model: {path}: {ast.unparse(node)}"


def _targets(node: ast.AST) -> Iterator[ast.Attribute]:
    """The attributes that a statement sets."""
    waiting: list[ast.AST] = []
    if isinstance(node, ast.Assign):
        waiting = list(node.targets)
    elif isinstance(node, ast.AugAssign | ast.AnnAssign | ast.For):
        waiting = [node.target]
    elif isinstance(node, ast.With):
        waiting = [item.optional_vars for item in node.items if item.optional_vars is not None]
    while waiting:
        target = waiting.pop()
        if isinstance(target, ast.Tuple | ast.List):
            waiting += target.elts
        elif isinstance(target, ast.Starred):
            waiting.append(target.value)
        elif isinstance(target, ast.Attribute):
            yield target


def set_from_outside(sources: dict[str, ast.Module]) -> Iterator[str]:
    """Every attribute that is set on something else than self or cls, setattr included."""
    for path, tree in sources.items():
        for node in ast.walk(tree):
            for target in _targets(node):
                own = isinstance(target.value, ast.Name) and target.value.id in ("self", "cls")
                if not own and target.attr not in FOREIGN:
                    yield f"set: {path}: {ast.unparse(target)}"
            if not isinstance(node, ast.Call) or ast.unparse(node.func) not in ("setattr", "object.__setattr__"):
                continue
            if ast.unparse(node.args[0]) not in ("self", "cls"):
                yield f"set: {path}: {ast.unparse(node)}"


def violations() -> set[str]:
    """All that does not hold."""
    sources = _sources()
    graph = imports(sources)
    return {
        *circles(graph),
        *upward_arrows(graph),
        *compared_models(sources),
        *set_from_outside(sources),
    }


def test_nothing_is_wrong_with_the_house():
    assert sorted(violations()) == []


def test_the_checker_imports_no_other_room():
    for path in sorted((ROOT / "ctr_nlp" / "check").rglob("*.py")):
        for name in _imported_names(ast.parse(path.read_text(encoding="utf-8"))):
            package = name.split(".")[0]
            own = name == "ctr_nlp.check" or name.startswith("ctr_nlp.check.")
            assert own or package in {"numpy", "scipy"} | sys.stdlib_module_names, f"{path.name} imports {name}"


def _imported_names(tree: ast.Module) -> set[str]:
    """Modules that a file imports."""
    found = {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
    return found | {node.module or "" for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}


def test_circles_are_seen_wherever_the_import_stands():
    sources = {
        "ctr_nlp/ocp/a.py": ast.parse("def f():\n    from ctr_nlp.ocp.b import g\n"),
        "ctr_nlp/ocp/b.py": ast.parse("if TYPE_CHECKING:\n    from ctr_nlp.ocp import c\n"),
        "ctr_nlp/ocp/c.py": ast.parse("from . import a\n"),
        "ctr_nlp/ocp/d.py": ast.parse("import ctr_nlp.ocp.a\n"),
    }
    edges = {"a -> ctr_nlp.ocp.b", "b -> ctr_nlp.ocp.c", "c -> ctr_nlp.ocp.a"}
    assert set(circles(imports(sources))) == {f"circle: ctr_nlp.ocp.{edge}" for edge in edges}


def test_the_core_imports_no_feature():
    graph = imports(_sources())
    rooms = {module: module.split(".")[1] for module in graph if "." in module}
    assert not [
        f"{module} -> {other}"
        for module, imported in graph.items()
        for other in imported
        if rooms.get(module) in (*CORE, *GROUND) and rooms.get(other) in FEATURES
    ]


def test_arrows_upwards_and_between_strangers_are_seen():
    graph = {
        "ctr_nlp.plan.plan": {"ctr_nlp.hardware.clock"},
        "ctr_nlp.hardware.clock": {"ctr_nlp.anatomy.files"},
        "ctr_nlp.anatomy.files": {"ctr_nlp.paths.curve"},
        "ctr_nlp.paths.curve": {"ctr_nlp"},
    }
    assert {arrow.partition(": ")[2] for arrow in upward_arrows(graph)} == {
        "ctr_nlp.plan.plan -> ctr_nlp.hardware.clock",
        "ctr_nlp.hardware.clock -> ctr_nlp.anatomy.files",
        "ctr_nlp.paths.curve -> ctr_nlp",
    }


@pytest.mark.parametrize(
    "text",
    [
        'model == "elastic"',
        '"dominant" != plan.model',
        'name in ("dominant", "other")',
        'name not in ["elastic"]',
        'match name:\n    case "elastic":\n        pass',
    ],
)
def test_comparisons_with_a_model_are_seen(text):
    assert len(list(compared_models({"ctr_nlp/planning/x.py": ast.parse(text)}))) == 1
    assert not list(compared_models({REGISTRY: ast.parse(text)}))


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("frames.near = 1", 1),
        ("self.part.near = 1", 1),
        ("a, (b.x, *c.y) = d", 2),
        ("a.x += 1", 1),
        ("a.x: int = 1", 1),
        ("for a.x in b: pass", 1),
        ("setattr(a, 'x', 1)", 1),
        ("self.x, y[0] = 1, 2", 0),
        ("object.__setattr__(self, 'x', 1)", 0),
        ("library.merit.restype = None", 0),
    ],
)
def test_attributes_set_from_outside_are_seen(text, count):
    assert len(list(set_from_outside({"ctr_nlp/planning/x.py": ast.parse(text)}))) == count
