"""Corrupted files of every kind that commands read, made from good ones by a seed."""

from __future__ import annotations

import copy
import datetime
import functools
import io
import json
import math
import random
import re
import sys
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from malformed import EXAMPLES, RIG, ROBOT, legacy_vtk, markups, mask, plan, plan_entries, table

from ctr_nlp.plan.plan_data import DIGEST, PLAN_ARRAY_SHAPES, digest

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

TEMPLATES = EXAMPLES.parent / "ctr_nlp" / "cli" / "templates"
WRONG = [
    *(None, True, False, 0, -1, 1, 7, 2**31, 10**30, -0.5, 1e-300, 1e300, math.nan, math.inf, -math.inf),
    *("", "x", "nan", "0", "a\x00b", "../../x", "\u202e[red]", "9" * 400),
    *(
        [],
        {},
        [[]],
        [0, []],
        [[1, 2], [3]],
        ["x"],
        [None],
        [math.nan] * 3,
        {"a": 1},
        [{"a": 1}],
        [[[1]]],
        [1] * 50,
    ),
]
"""Values of wrong types or sizes, some of which a key may take."""


class Corrupted(NamedTuple):
    """A file that was spoilt.

    Attributes
    ----------
    kind : str
        Of file, a key of GOOD.
    how : str
        What was done to it.
    name : str
        Of the file.
    content : bytes
        Of the file.
    whole : bool
        Whether what it says was changed only where its reader cannot notice, so that it must be refused or say the
        same as before.
    refused : bool
        Whether no reader may take it.
    """

    kind: str
    how: str
    name: str
    content: bytes
    whole: bool = False
    refused: bool = False


def configurations() -> str:
    """Configurations of the plan as `ctr-nlp import` reads them."""
    names = [f"{axis}_{'mm' if axis.startswith('beta') else 'rad'}" for axis in plan().robot.axes]
    return "\n".join([",".join(names), *(",".join(map(str, row)) for row in plan().q.tolist())]) + "\n"


def plan_bytes(entries: dict[str, Any], compressed: bool = True) -> bytes:
    """A plan.npz of some entries; meta is a JSON object or text."""
    held = io.BytesIO()
    found = dict(entries)
    if "meta" in found and not isinstance(found["meta"], str):
        found["meta"] = json.dumps(found["meta"])
    save = np.savez_compressed if compressed else np.savez
    save(held, **{name: np.asarray(value) for name, value in found.items()})
    return held.getvalue()


def sealed(entries: dict[str, Any]) -> dict[str, Any]:
    """The entries with the digest that belongs to them."""
    meta = json.dumps(entries["meta"])
    arrays = {name: np.asarray(value) for name, value in entries.items() if name in PLAN_ARRAY_SHAPES}
    return {DIGEST: np.array(digest(arrays, meta)), **entries, "meta": meta}


def drawn_entries() -> dict[str, Any]:
    """Entries of a plan that holds its robustness."""
    with np.load(io.BytesIO(_drawn()), allow_pickle=False) as data:
        entries: dict[str, Any] = {name: data[name] for name in data.files if name != DIGEST}
    return entries | {"meta": json.loads(str(entries["meta"]))}


@functools.cache
def _drawn() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "plan.npz"
        plan().with_samples(3, 1).save(path)
        return path.read_bytes()


def uncommented(text: str) -> str:
    """A template with its optional keys given, as far as a line can be read alone."""
    return re.sub(r"^# (\w+ = )", r"\1", text, flags=re.MULTILINE)


LOAD = (TEMPLATES / "load.toml").read_text(encoding="utf-8")
STUDY = '[problems]\nnames = ["arc"]\nsynthetic = 1\noptions = { trim = "end" }\n' + (
    '[robots]\ndrawn = { of = "robot.toml", count = 2, seed = 0 }\n'
    '[[ways]]\nmodels = ["dominant"]\nmethods = ["joint"]\nsettings = { stability_margin = [0.1, 0.3] }\n'
    '[ways.sample]\nmethod = "sobol"\ncount = 2\nseed = 0\nranges = { motion_weight = [1e-7, 1e-5] }\n'
)
GOOD: dict[str, tuple[str, Callable[[], bytes]]] = {
    "plan": ("plan.npz", lambda: plan_bytes(sealed(plan_entries()))),
    "robot": ("robot.toml", ROBOT.encode),
    "hardware": ("rig.toml", RIG.encode),
    "csv path": ("path.csv", table().encode),
    "slicer path": ("path.mrk.json", lambda: json.dumps(markups()).encode()),
    "vtk path": ("path.vtk", legacy_vtk().encode),
    "mask": ("mask.nrrd", mask),
    "load": ("load.toml", LOAD.encode),
    "study": ("study.toml", STUDY.encode),
    "configurations": ("q.csv", lambda: configurations().encode()),
}
"""Names and contents of good files."""
SHARES = {"plan": 9, "robot": 6, "hardware": 6, "csv path": 3, "slicer path": 3, "vtk path": 2, "mask": 2}
SHARES |= {"load": 2, "study": 2, "configurations": 2}
"""How many files there are of each kind, in proportion."""
TOML = "robot", "hardware", "load", "study"


def corrupted(count: int, seed: int) -> Iterator[Corrupted]:
    """So many files, the same ones for the same seed; the first few hold every kind."""
    chance = random.Random(seed)
    kinds = [kind for kind, share in SHARES.items() for _ in range(share)]
    good = {kind: make() for kind, (_, make) in GOOD.items()}
    for number in range(count):
        kind = kinds[number * 11 % len(kinds)]
        ways: list[Callable[[random.Random, str, bytes], Corrupted]] = [_bytes, _bytes, _tokens]
        ways += (
            [_toml] * 5 * (kind in TOML) + [_plan] * 6 * (kind == "plan") + [_json] * 4 * (kind == "slicer path")
        )
        ways += [_cells] * 4 * (kind in ("csv path", "configurations"))
        yield chance.choice(ways)(chance, kind, good[kind])


def _made(kind: str, how: str, content: bytes, **more: bool) -> Corrupted:
    return Corrupted(kind, how, GOOD[kind][0], content, **more)


def _bytes(chance: random.Random, kind: str, good: bytes) -> Corrupted:
    """Bytes cut, flipped, overwritten, repeated or in another encoding."""
    at, size = chance.randrange(len(good)), chance.choice([1, 2, 8, 64, 600])
    text = kind not in ("plan", "mask")
    how = chance.choice(
        ["truncated", "flipped", "overwritten", "repeated", "dropped", "empty", "zeros", *["encoded"] * text]
    )
    whole = kind == "plan"
    if how == "truncated":
        return _made(kind, how, good[:at], whole=whole)
    if how == "flipped":
        content = bytearray(good)
        for _ in range(chance.choice([1, 1, 4, 40])):
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
        return _made(kind, how, bytes(content), whole=whole)
    if how == "overwritten":
        return _made(kind, how, good[:at] + chance.randbytes(size) + good[at + size :], whole=whole)
    if how == "repeated":
        return _made(kind, how, good[: at + size] + good[at:], whole=whole)
    if how == "dropped":
        return _made(kind, how, good[:at] + good[at + size :], whole=whole)
    if how == "empty":
        return _made(kind, how, chance.choice([b"", b"\n", b" ", b"\x00"]), refused=True)
    if how == "zeros":
        return _made(kind, how, good[:at] + bytes(len(good) - at), whole=whole)
    encoding = chance.choice(["utf-16", "utf-16-le", "utf-32", "utf-8-sig", "cp500", "latin-1"])
    written = good.decode().replace("a", "é", 1) if encoding == "latin-1" else good.decode()
    return _made(kind, f"encoded {encoding}", written.encode(encoding), refused=encoding == "cp500")


TOKEN = re.compile(rb"[^\s,=\[\]{}():\"']+")


def _tokens(chance: random.Random, kind: str, good: bytes) -> Corrupted:
    """Words or numbers exchanged with each other or for what is none."""
    if kind in ("plan", "mask"):
        return _bytes(chance, kind, good)
    places = [found.span() for found in TOKEN.finditer(good)]
    content, how = good, chance.choice(["exchanged", "replaced", "replaced"])
    for _ in range(chance.choice([1, 1, 2, 5])):
        first, second = sorted(chance.sample(range(len(places)), 2))
        (a, b), (c, d) = places[first], places[second]
        if how == "exchanged":
            content = good[:a] + good[c:d] + good[b:c] + good[a:b] + good[d:]
            break
        new = chance.choice(
            [b"nan", b"inf", b"-1", b"1e400", b"1e308", b"0", b"", b"true", b"x", b"9" * 5000, b"0x10"]
        )
        content = content[:a] + new + content[b:]
        places = [found.span() for found in TOKEN.finditer(content)]
        if len(places) < 3:
            break
    return _made(kind, how, content)


def _places(found: Any, place: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Where the values of nested tables and lists are."""
    items = found.items() if isinstance(found, dict) else enumerate(found) if isinstance(found, list) else ()
    for key, value in items:
        yield (*place, key)
        yield from _places(value, (*place, key))


def _spoil(chance: random.Random, good: Any) -> tuple[str, Any]:
    """Nested tables with a value of a wrong type, or a key missing, added or called otherwise."""
    found = copy.deepcopy(good)
    places = list(_places(found))
    how = chance.choice(
        ["wrong type", "wrong type", "wrong type", "missing key", "extra key", "renamed key", "twice"]
    )
    *way, last = chance.choice(places)
    at = found
    for key in way:
        at = at[key]
    if how == "wrong type":
        at[last] = value = copy.deepcopy(chance.choice(WRONG))
        return f"{how} {'.'.join(map(str, (*way, last)))} = {value!r:.30}", found
    if how == "missing key":
        del at[last]
    elif how == "extra key" and isinstance(at, dict):
        at[chance.choice(["name", "extra", "", "a b", "__class__", "\u202e"])] = copy.deepcopy(
            chance.choice(WRONG)
        )
    elif how == "renamed key" and isinstance(at, dict):
        at[f"{last}s"] = at.pop(last)
    elif isinstance(at, list):
        how = "twice"
        at.insert(last, copy.deepcopy(at[last]))
    else:
        how = "extra key"
        at["extra"] = 1
    return f"{how} {'.'.join(map(str, (*way, last)))}", found


def as_toml(found: Any) -> str:
    """A value as TOML writes it within a line."""
    if isinstance(found, dict):
        return "{" + ", ".join(f"{json.dumps(str(key))} = {as_toml(value)}" for key, value in found.items()) + "}"
    if isinstance(found, list):
        return "[" + ", ".join(map(as_toml, found)) + "]"
    if found is None:
        return "1979-05-27"
    if isinstance(found, bool | str):
        return json.dumps(found).replace("\x7f", "\\u007f")
    if isinstance(found, datetime.date | datetime.time):
        return found.isoformat()
    return repr(found)


def _toml(chance: random.Random, kind: str, good: bytes) -> Corrupted:
    how, found = _spoil(chance, tomllib.loads(good.decode()))
    lines = [f"{json.dumps(key)} = {as_toml(value)}\n" for key, value in found.items()]
    return _made(kind, how, "".join(lines).encode())


def _json(chance: random.Random, kind: str, good: bytes) -> Corrupted:
    how, found = _spoil(chance, json.loads(good))
    return _made(kind, how, json.dumps(found).encode())


def _cells(chance: random.Random, kind: str, good: bytes) -> Corrupted:
    """A table with cells, rows or columns spoilt."""
    rows = [line.split(",") for line in good.decode().splitlines()]
    how = chance.choice(
        ["cell", "cell", "ragged", "no head", "head twice", "one row", "same row", "separator", "quotes", "column"]
    )
    row = chance.randrange(1, len(rows))
    cell = chance.randrange(len(rows[0]))
    if how == "cell":
        rows[row][cell] = new = chance.choice(
            ["", "nan", "inf", "-inf", "1e400", "1e300", "x", "1,5", '"', "1_0", "０", "-1", "True", "9" * 200_000]
        )
        how = f"cell {new:.10}"
    elif how == "ragged":
        rows[row] = rows[row][:cell] or [*rows[row], "1"]
    elif how == "no head":
        del rows[0]
    elif how == "head twice":
        rows.insert(row, rows[0])
    elif how == "one row":
        del rows[2:]
    elif how == "same row":
        rows[1:] = [rows[1]] * (len(rows) - 1)
    elif how == "quotes":
        rows[row][cell] = f'"{rows[row][cell]}'
    elif how == "column":
        rows = [[*each[:cell], *each[cell + 1 :]] for each in rows]
    separator = chance.choice([";", "\t", " ", ", "]) if how == "separator" else ","
    end = chance.choice(["\n", "\r\n", "\r"])
    return _made(kind, f"table: {how}", end.join(map(separator.join, rows)).encode())


DTYPES = "U5", "S5", "c16", "?", "i8", "u1", "f2", "f4", ">f8", "M8[s]", "V8"


def _plan(chance: random.Random, kind: str, good: bytes) -> Corrupted:
    """A plan.npz with an entry missing, or of another type, shape or value; with a digest that fits, or none."""
    entries: dict[str, Any] = copy.deepcopy(plan_entries() if chance.random() < 0.7 else drawn_entries())
    names = [name for name in entries if name != "meta"]
    name = chance.choice(names)
    how = chance.choice(["meta", "meta", "meta", "missing", "dtype", "shape", "values", "zip", "header", "extra"])
    if how == "meta":
        told, entries["meta"] = _spoil(chance, entries["meta"])
        how = f"meta: {told}"
    elif how == "missing":
        name = chance.choice([*names, "meta"])
        del entries[name]
        how = f"missing {name}"
    elif how == "dtype":
        kind_of = chance.choice(DTYPES)
        with np.errstate(all="ignore"):
            entries[name] = (
                np.zeros(entries[name].shape, kind_of)
                if kind_of in ("M8[s]", "V8")
                else np.nan_to_num(entries[name]).astype(kind_of)
            )
        how = f"dtype {name} {kind_of}"
    elif how == "shape":
        array = entries[name]
        entries[name] = chance.choice(
            [
                array[:0],
                array[None],
                array.ravel(),
                array.T,
                array[:-1],
                array[..., :1],
                np.float64(1.0),
                array[()].sum(),
            ]
        )
        how = f"shape {name}"
    elif how == "values":
        value = chance.choice([math.nan, math.inf, -math.inf, 1e300, -1e300, 1e-300, 0.0, -1.0])
        array = np.array(entries[name])
        if array.dtype.kind == "f":
            array[tuple(chance.randrange(n) for n in array.shape) if chance.random() < 0.5 else ...] = value
        else:
            array = np.zeros_like(array)
        entries[name] = array
        how = f"values {name} {value}"
    elif how == "extra":
        entries["extra"] = np.array([1, 2])
    if how in ("zip", "header"):
        return _archive(chance, how, entries)
    if "meta" in entries and not how.endswith("M8[s]") and chance.random() < 0.5:  # the digest reads no times
        return _made(kind, f"{how}, sealed", plan_bytes(sealed(entries)))
    return _made(kind, how, plan_bytes(entries, chance.random() < 0.5))


def _archive(chance: random.Random, how: str, entries: dict[str, Any]) -> Corrupted:
    """A member of the archive that lies about its size, is no array, pickled, or there twice."""
    held, good = io.BytesIO(), plan_bytes(sealed(entries))
    which = chance.choice(["pickled", "no array", "huge", "twice", "negative", "deep header", "folder", "object"])
    with zipfile.ZipFile(io.BytesIO(good)) as read, zipfile.ZipFile(held, "w", zipfile.ZIP_DEFLATED) as write:
        members = [name for name in read.namelist() if name != "digest.npy"]
        chosen = chance.choice(members)
        for name in read.namelist():
            content = read.read(name)
            if name == chosen:
                if which == "pickled":
                    content = b"\x80\x04N."
                elif which == "no array":
                    content = b"text"
                elif which == "object":
                    content = content.replace(b"'<f8'", b"'|O'  ")
                elif which in ("huge", "negative"):
                    size = b"1000000000000," if which == "huge" else b"-5,"
                    content = re.sub(rb"'shape': \(([^)]*)\)", b"'shape': (" + size + b")", content)
                elif which == "deep header":
                    content = content.replace(b"{'descr'", b"(" * 500 + b"{'descr'")
                elif which == "folder":
                    write.writestr(f"{name}/", b"")
                else:
                    write.writestr(f"./{name}", content)
            write.writestr(name, content)
    return Corrupted("plan", f"{how}: {which} {chosen}", "plan.npz", held.getvalue(), whole=True)
