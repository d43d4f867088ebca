"""Write the results of commands on forces: JSON, a CSV row a frame, and a picture."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from ctr_nlp.cli.output.file import write_text
from ctr_nlp.cli.output.folder import output_folder
from ctr_nlp.loads.tip import Forces
from ctr_nlp.loads.wall import WallForces
from ctr_nlp.support.tables import write_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def write_forces(
    found: Forces | WallForces, out: Path, kind: str, stem: str, picture: Callable[[], Figure] | None
) -> list[str]:
    """Write STEM.json, STEM.csv and STEM.png into out, as files of a kind.

    Parameters
    ----------
    found : Forces or WallForces
        Forces to write.
    out : Path
        The output folder.
    kind : str
        Kind of the run, a key of STANDARD in ctr_nlp/cli/output/manifest.py.
    stem : str
        Stem of the files' names.
    picture : callable or None
        Draws the picture; None for none.

    Returns
    -------
    list of str
        Names of the files within out.

    Raises
    ------
    OutputError
        The files cannot be written.
    """
    with output_folder(out, kind) as staging:
        write_text(staging / f"{stem}.json", json.dumps(found.summary(), indent=2, allow_nan=False) + "\n")
        write_csv(staging / f"{stem}.csv", found.rows())
        if picture is not None:
            from ctr_nlp.view.figures import save  # brings matplotlib, which takes long to load

            save(picture(), staging / f"{stem}.png")
        return sorted(path.name for path in staging.iterdir())
