"""Libraries that only some users need, imported when they are used."""

from __future__ import annotations

import importlib
import shlex
import sys
from pathlib import Path
from typing import Any

from ctr_nlp.exceptions import OptionError

EXTRAS = {
    "hardware": ("toppra", "serial", "filelock", "ur_analytic_ik", "rosbags"),
    "ur": ("rtde_control", "rtde_receive"),
    "ros2": ("cyclonedds",),
    "igtl": ("pyigtl",),
    "anatomy": ("nibabel", "nrrd", "networkx", "pyvista", "vtkmodules"),
    "live": ("viser", "websockets"),
    "report": ("k3d", "jinja2"),
    "completion": ("shtab",),
    "sampling": ("ompl",),
    "learning": ("torch",),
    "gpu": ("nvidia",),
    "study": ("dask", "distributed", "tornado", "pyarrow", "pandas"),
}
"""The modules that each extra of this package brings."""


def import_extra(module: str) -> Any:
    """Import an optional module and return it.

    module: dotted name of a module of one of EXTRAS. Raises OptionError, which names the command that installs it,
    where it is missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        (extra,) = (extra for extra, modules in EXTRAS.items() if module.partition(".")[0] in modules)
        raise OptionError(
            f"{module} is not installed; this command installs it: {install_command(extra)} ({error})"
        ) from error


def install_command(extra: str) -> str:
    """Return the command that installs an extra into the environment that runs; extra: one of EXTRAS."""
    # `pip` alone may be that of another environment, or be on no path.
    python = Path(sys.executable)
    if python.is_relative_to(Path.cwd()):
        python = python.relative_to(Path.cwd())
    return f'{shlex.quote(str(python))} -m pip install "ctr_nlp[{extra}]"'
