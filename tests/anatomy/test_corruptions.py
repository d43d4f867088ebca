"""Damaged files of points: each is read to the same path, or with a note, or refused with the cause."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

from ctr_nlp.anatomy.branch_selection import read_branch_segment
from ctr_nlp.exceptions import CurveError, OptionError
from ctr_nlp.paths.curve import curve_from_points

IN_CI, IN_ALL = 300, 1000
ALLOWED_MM = 0.5
"""How far a path that is read without a note may be from the right one."""
FLIP = np.array([-1.0, -1.0, 1.0])


@dataclass
class Case:
    """A file and how it is read.

    points: (n, 3) mm, as written. radius: (n,) mm or None. header, separator, decimal, encoding: of a table.
    extra: cells by column name. edit: of the bytes of the file. markup: edit of the markup. name: of the file.
    known: whether entry and target are given, without which a mirrored, turned or shortened path is as good.
    """

    points: np.ndarray
    radius: np.ndarray | None
    header: list[str] = field(default_factory=lambda: ["x_mm", "y_mm", "z_mm"])
    radius_name: str = "radius_mm"
    separator: str = ","
    decimal: str = "."
    encoding: str = "utf-8"
    top: str = ""
    name: str = "path.csv"
    extra: dict[str, list[str]] = field(default_factory=dict)
    cells: dict[tuple[int, int], str] = field(default_factory=dict)
    edit: Callable[[bytes], bytes] = lambda raw: raw
    markup: Callable[[dict], None] = lambda _: None
    known: bool = False

    def content(self) -> bytes:
        return self.edit((self._markups() if self.name.endswith("json") else self._table()).encode(self.encoding))

    def _table(self) -> str:
        columns = [*self.header, *([self.radius_name] if self.radius is not None else []), *self.extra]
        rows = []
        for k, point in enumerate(self.points):
            numbers = [*point, *([] if self.radius is None else [self.radius[k]])]
            cells = [f"{number:.4f}".replace(".", self.decimal) for number in numbers]
            cells += [column[k] for column in self.extra.values()]
            rows.append([self.cells.get((k, j), cell) for j, cell in enumerate(cells)])
        lines = [self.separator.join(row) for row in ([columns, *rows] if self.header else rows)]
        return self.top + "\n".join(lines) + "\n"

    def _markups(self) -> str:
        controls = [{"id": str(k), "position": list(map(float, p))} for k, p in enumerate(self.points, start=1)]
        markup: dict = {
            "type": "Curve",
            "coordinateSystem": "LPS",
            "coordinateUnits": "mm",
            "controlPoints": controls,
        }
        if self.radius is not None:
            values = [float(value) for value in self.radius]
            markup["measurements"] = [{"name": "Radius", "units": "mm", "controlPointValues": values}]
        for (k, j), cell in self.cells.items():
            if j < 3:
                controls[k]["position"][j] = float("nan") if cell == "nan" else cell
            elif self.radius is not None:
                markup["measurements"][0]["controlPointValues"][k] = float("nan") if cell == "nan" else cell
        self.markup(markup)
        return json.dumps({"markups": [markup]}, indent=1)


def good(random: np.random.Generator) -> Case:
    """A path of 80 to 140 mm that bends in two planes, in a file of some usual form."""
    count = int(random.integers(40, 120))
    u = np.linspace(0, 1, count)
    length = random.uniform(80, 140)
    bend = random.uniform(0.5, 1.2)
    points = length * np.column_stack(
        [(1 - np.cos(bend * u)) / bend, random.uniform(0.05, 0.2) * u**3, np.sin(bend * u) / bend]
    )
    points += random.uniform(-80, 80, 3) + np.array([0, 25, 0])
    radius = np.linspace(8, 4, count) if random.random() < 0.7 else None
    case = Case(points, radius)
    case.name = ("path.csv", "path.mrk.json", "path.dat", "path.txt")[random.integers(4)]
    if not case.name.endswith("json"):
        case.separator, case.decimal = ((",", "."), (";", ","), ("\t", "."), (";", "."))[random.integers(4)]
    return case


# Corruptions: each takes a good case and changes it.


def order(case: Case, random: np.random.Generator) -> None:
    count = len(case.points)
    numbers = np.arange(count)
    way = random.integers(8)
    k = int(random.integers(1, count - 1))
    if way == 0:
        numbers = random.permutation(count)
    elif way == 1:
        numbers = np.roll(numbers, -k)
    elif way == 2:
        numbers = np.roll(numbers, -1)
    elif way == 3:
        numbers[[k - 1, k]] = numbers[[k, k - 1]]
    elif way == 4:
        i, j = random.choice(count, 2, replace=False)
        numbers[[i, j]] = numbers[[j, i]]
    elif way == 5:
        stop = min(count, k + int(random.integers(2, 30)))
        numbers[k:stop] = numbers[k:stop][::-1].copy()
    elif way == 6:
        numbers = np.argsort(case.points[:, random.integers(3)], kind="stable")
    else:
        numbers = numbers[::-1]
        case.known = case.radius is None
    case.points = case.points[numbers]
    case.radius = None if case.radius is None else case.radius[numbers]


def scale(case: Case, random: np.random.Generator) -> None:
    factor = (0.1, 10, 0.001, 1000)[random.integers(4)]
    case.points = case.points * factor
    if case.radius is not None and random.random() < 0.7:
        case.radius = case.radius * factor
    if random.random() < 0.3:
        case.header = ["x", "y", "z"]


def mirror(case: Case, random: np.random.Generator) -> None:
    signs = np.where(random.random(3) < 0.5, -1, 1)
    signs[random.integers(3)] = -1
    case.points = case.points * signs
    case.known = True


def exchanged_axes(case: Case, random: np.random.Generator) -> None:
    axes = [[1, 0, 2], [2, 1, 0], [0, 2, 1], [1, 2, 0], [2, 0, 1]][random.integers(5)]
    case.points = case.points[:, axes]
    if random.random() < 0.4 and not case.name.endswith("json"):
        case.header = [case.header[axis] for axis in axes]  # the header tells it: the same path
    else:
        case.known = True


def duplicate(case: Case, random: np.random.Generator) -> None:
    count = len(case.points)
    way = random.integers(4)
    numbers = np.arange(count)
    k = int(random.integers(count))
    if way == 0:
        numbers = np.insert(numbers, k, k)
    elif way == 1:
        numbers = np.repeat(numbers, 2)
    elif way == 2:
        numbers = np.append(numbers, numbers)
    else:
        numbers = np.insert(numbers, int(random.integers(count)), k)
    case.points = case.points[numbers]
    case.radius = None if case.radius is None else case.radius[numbers]


def gap(case: Case, random: np.random.Generator) -> None:
    count = len(case.points)
    if random.random() < 0.3:
        keep = random.random(count) < random.uniform(0.3, 0.9)
        keep[[0, -1]] = True
    else:
        width = int(random.integers(1, count // 2))
        start = int(random.integers(1, count - width))
        keep = np.ones(count, bool)
        keep[start : start + width] = False
        keep[-1] = True
    case.points = case.points[keep]
    case.radius = None if case.radius is None else case.radius[keep]


def not_a_number(case: Case, random: np.random.Generator) -> None:
    width = 3 if case.radius is None else 4
    count = len(case.points)
    k = (0, count - 1, int(random.integers(count)))[random.integers(3)]
    words = ["nan", "inf", "", "abc", "1e999", "0", "-1", "--", "1,5,2", "0x10", "1_0"]
    case.cells = {(k, int(random.integers(width))): words[random.integers(len(words))]}
    if random.random() < 0.2 and case.radius is not None:
        case.cells = {(k, 3): ("nan", "0")[random.integers(2)] for k in range(count)}


def outlier(case: Case, random: np.random.Generator) -> None:
    k = int(random.integers(len(case.points)))
    move = random.normal(size=3)
    case.points = case.points.copy()
    case.points[k] += move / np.linalg.norm(move) * random.uniform(5, 200)


def columns(case: Case, random: np.random.Generator) -> None:
    count = len(case.points)
    if case.name.endswith("json"):
        way = random.integers(5)
        if way == 0:
            case.markup = lambda markup: [control["position"].pop() for control in markup["controlPoints"]]
        elif way == 1:
            case.markup = lambda markup: markup["controlPoints"][count // 2].pop("position")
        elif way == 2:
            case.markup = lambda markup: [control["position"].append(0.0) for control in markup["controlPoints"]]
        elif way == 3:
            case.markup = lambda markup: markup.update(coordinateSystem="IJK")
        elif way == 4:
            case.radius = np.linspace(8, 4, count)
            case.markup = lambda markup: markup["measurements"][0]["controlPointValues"].pop()
        return
    way = random.integers(6)
    number = [str(k) for k in range(count)]
    if way == 0:
        case.header = [case.header[k] for k in (0, 1)]
    elif way == 1:
        case.extra = {("id", "Curvature", "min_radius", "width", "", "quality")[random.integers(6)]: number}
    elif way == 2:
        case.extra = {case.header[random.integers(3)]: number}
    elif way == 3:
        case.radius_name = ("misc", "Radius", "diam", "radius_cm", "diameter_mm", "CellRadius")[random.integers(6)]
    elif way == 4:
        case.header = [*case.header, "w"]
    else:
        case.header[random.integers(3)] = "q"


def header(case: Case, random: np.random.Generator) -> None:
    if case.name.endswith("json"):
        key, value = (
            ("type", "ClosedCurve"),
            ("type", "Fiducial"),
            ("coordinateSystem", "RAS"),
            ("coordinateSystem", None),
            ("coordinateUnits", "cm"),
            ("coordinateUnits", "m"),
            ("coordinateUnits", None),
            ("controlPoints", {}),
        )[random.integers(8)]
        case.known = key == "coordinateSystem"
        case.markup = lambda markup: markup.update({key: value})
        return
    way = random.integers(8)
    if way == 0:
        case.header = []
    elif way == 1:
        case.top = "Case 7\n"
    elif way == 2:
        case.top = "# Case 7\n\n"
    elif way == 3:
        case.header = ["X", "Y", "Z"]
    elif way == 4:
        case.header = ["Points:0", "Points:1", "Points:2"]
    elif way == 5:
        unit = ("cm", "m", "um", "inch")[random.integers(4)]
        case.header = [f"{axis}_{unit}" for axis in "xyz"]
    elif way == 6:
        case.header = ["lat", "lon", "height"]
    else:
        case.top = case.separator.join(["x_mm", "y_mm", "z_mm"]) + "\n"


def encoding(case: Case, random: np.random.Generator) -> None:
    way = random.integers(6)
    if way < 4:
        case.encoding = ("utf-16", "utf-8-sig", "utf-16-le", "latin-1")[way]
    elif way == 4:
        case.edit = lambda raw: raw.replace(b"\n", (b"\r\n", b"\r")[len(raw) % 2])
    else:
        places = random.integers(0, 10**6, 3)
        case.edit = lambda raw: bytes(0 if k in places % len(raw) else b for k, b in enumerate(raw))


def one_byte(case: Case, random: np.random.Generator) -> None:
    place, value = int(random.integers(10**6)), int(random.integers(32, 127))
    case.edit = lambda raw: raw[: place % len(raw)] + bytes([value]) + raw[place % len(raw) + 1 :]


def truncation(case: Case, random: np.random.Generator) -> None:
    part = random.uniform(0.0, 1.0)
    case.edit = lambda raw: raw[: int(part * len(raw))]
    case.known = True


CORRUPTIONS = (
    *(order, scale, mirror, exchanged_axes, duplicate, gap, not_a_number),
    *(outlier, columns, header, encoding, one_byte, truncation),
)


def read(path, case, truth):
    ends = {"entry": truth[0], "target": truth[-1]} if case.known else {}
    segment = read_branch_segment(path, **ends)
    # Both in the file's own coordinates: a wrong name of the axes turns the patient, not the path.
    return segment.followed_path.apply_transform(np.linalg.inv(segment.to_lps)), set(segment.facts.notes)


def outcome(folder, seed):
    """What becomes of one damaged file: the kind of damage, and "same", "note", "refused" or "WRONG"."""
    random = np.random.default_rng(seed)
    damage = CORRUPTIONS[seed % len(CORRUPTIONS)]
    case = good(random)
    path = folder / case.name
    path.write_bytes(case.content())
    truth = case.points
    curve, usual = read(path, case, truth)
    assert curve.length == pytest.approx(curve_from_points(truth).length, abs=0.01)
    damage(case, random)
    path.write_bytes(case.content())
    try:
        found, notes = read(path, case, truth)
    except (CurveError, OptionError):
        return damage.__name__, "refused"
    s = np.linspace(0, 1, 200)
    off = np.linalg.norm(found.point(s * found.length) - curve.point(s * curve.length), axis=1).max()
    if off <= ALLOWED_MM and abs(found.length - curve.length) <= 2 * ALLOWED_MM:
        return damage.__name__, "same"
    return damage.__name__, "note" if notes - usual else f"WRONG: seed {seed}, {off:.1f} mm off"


def check(folder, seeds):
    found = Counter(outcome(folder, seed) for seed in seeds)
    wrong = [f"{kind}: {result}" for kind, result in found if result.startswith("WRONG")]
    print("\n".join(f"{kind:16} {result:10} {count}" for (kind, result), count in sorted(found.items())))
    assert wrong == []


def test_no_damaged_file_gives_a_wrong_path_silently(tmp_path):
    check(tmp_path, range(IN_CI))


@pytest.mark.slow
def test_no_damaged_file_of_a_thousand_gives_a_wrong_path_silently(tmp_path):
    check(tmp_path, range(10_000, 10_000 + IN_ALL))
