"""Files of anatomy: the reader of every kind, by the ends of their names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from ctr_nlp.anatomy.branch import Branch, Branches, check_branches, checked_point
from ctr_nlp.anatomy.formats.images import NIFTI_SUFFIXES, NRRD_SUFFIXES
from ctr_nlp.anatomy.formats.slicer import read_slicer
from ctr_nlp.anatomy.formats.vtk import read_vtk
from ctr_nlp.anatomy.reading import AS_THE_FILE_SAYS, ReadOptions
from ctr_nlp.exceptions import CurveError, OptionError

CSV_SUFFIXES, MARKUPS_SUFFIXES, VTK_SUFFIXES = (".csv",), (".mrk.json", ".json"), (".vtp", ".vtk", ".vtu")
CENTRELINE_SUFFIXES, MASK_SUFFIXES = (
    (*CSV_SUFFIXES, *MARKUPS_SUFFIXES, *VTK_SUFFIXES),
    (*NIFTI_SUFFIXES, *NRRD_SUFFIXES),
)
ANATOMY_SUFFIXES = (*CENTRELINE_SUFFIXES, *MASK_SUFFIXES)


def centrelines_in(folder: str | Path) -> list[Path]:
    """Return the sorted centreline files in a folder; raise OptionError where it has none."""
    found = sorted(path for path in Path(folder).glob("*") if path.name.endswith(CENTRELINE_SUFFIXES))
    if not found:
        raise OptionError(f"folder {folder} has no centreline files ({', '.join(CENTRELINE_SUFFIXES)})")
    return found


def read_branches(
    path: str | Path,
    entry: npt.ArrayLike | None = None,
    target: npt.ArrayLike | None = None,
    options: ReadOptions = AS_THE_FILE_SAYS,
) -> Branches:
    """Read the branches of a centreline file, or the path between two points of a mask, each fit to be a curve.

    path: the file. entry: (3,) mm in the file's coordinates, where the robot enters; it settles where a tree in a
    VTK file starts, if the file does not. A mask needs it and target, (3,) mm too. options: what a person states
    about the file. Raises CurveError, and OptionError where a mask lacks one of them or an extra is missing.
    """
    for what, point in (("entry", entry), ("target", target)):
        if point is not None:
            checked_point(what, point)
    name = Path(path).name.lower()
    if name.endswith(MASK_SUFFIXES):
        if entry is None or target is None:
            raise OptionError(
                f"{path} is a mask, which has no branches: its path is found between two points in the lumen, to "
                "be given with --entry X Y Z and --target X Y Z where it is followed"
            )
        from ctr_nlp.anatomy.segmentation.mask import read_mask  # and with it scipy.ndimage: only where it is used

        return check_branches(path, read_mask(path, entry, target, options))
    if name.endswith(VTK_SUFFIXES):
        return check_branches(path, read_vtk(path, entry, options))
    if name.endswith(MARKUPS_SUFFIXES):
        return check_branches(path, read_slicer(path, options))
    if name.endswith(CSV_SUFFIXES):
        return check_branches(path, read_table(path, options))
    raise CurveError(f"{path} is not a known kind of file; its name must end in {', '.join(ANATOMY_SUFFIXES)}")


def is_mask(path: str | Path) -> bool:
    """Return whether the file `path` contains a mask rather than centrelines, by its name."""
    return Path(path).name.lower().endswith(MASK_SUFFIXES)


def title(path: str | Path) -> str:
    """Return the name of the file `path` without the suffix that identifies its kind."""
    name = Path(path).name
    known = [suffix for suffix in ANATOMY_SUFFIXES if name.lower().endswith(suffix)]
    return name[: -max(map(len, known))] if known else name


CENTRELINE_CSV_COLUMNS = ("x_mm", "y_mm", "z_mm")
EXPECTED = "expected a header x_mm,y_mm,z_mm and optionally radius_mm, then one point a line"


def read_table(path: str | Path, options: ReadOptions = AS_THE_FILE_SAYS) -> Branches:
    """Read the path of a CSV file with columns x_mm, y_mm, z_mm and optionally radius_mm.

    Such a file does not name the patient's axes: its coordinates stay as they are. options: what a person states
    about the file. Raises CurveError.
    """
    try:
        lines = [line for line in Path(path).read_text(encoding="utf-8-sig").splitlines() if line.strip()]
    except (OSError, UnicodeDecodeError) as error:
        raise CurveError(f"centreline {path} cannot be read: {error}") from error
    names = [name.strip().lower() for name in lines[0].split(",")] if lines else []
    if not set(CENTRELINE_CSV_COLUMNS) <= set(names) or len(set(names)) != len(names):
        raise CurveError(f"{path} is not a centreline: its first line is {(lines or [''])[0][:60]!r}; {EXPECTED}")
    rows = [_row(path, number, line, len(names)) for number, line in enumerate(lines[1:], start=2)]
    table = np.array(rows).reshape(len(rows), len(names))
    points = table[:, [names.index(name) for name in CENTRELINE_CSV_COLUMNS]]
    radius = table[:, names.index("radius_mm")] if "radius_mm" in names else None
    return Branches((Branch(Path(path).stem, points, radius),), "xyz", np.eye(4))


def _row(path: str | Path, number: int, line: str, width: int) -> list[float]:
    try:
        row = [float(cell) for cell in line.split(",")]
    except ValueError as error:
        raise CurveError(f"{path} is not a centreline: row {number} is {line[:60]!r}; {EXPECTED}") from error
    if len(row) != width:
        raise CurveError(f"{path}: row {number} has {len(row)} cells, but the header has {width}")
    return row
