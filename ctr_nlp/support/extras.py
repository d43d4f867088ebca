"""Libraries that only some users need, imported when they are used."""

from __future__ import annotations

import importlib
from typing import Any

from ctr_nlp.exceptions import OptionError

EXTRAS = {
    "toppra": "hardware",
    "serial": "hardware",
    "filelock": "hardware",
    "ur_analytic_ik": "hardware",
    "rosbags": "hardware",
    "rtde_control": "ur",
    "rtde_receive": "ur",
    "cyclonedds": "ros2",
    "nibabel": "anatomy",
    "nrrd": "anatomy",
    "networkx": "anatomy",
    "pyvista": "anatomy",
    "vtkmodules": "anatomy",
    "k3d": "report",
    "bokeh": "report",
    "jinja2": "report",
    "shtab": "completion",
}
"""Which extra of this package brings a module."""


def needed(module: str) -> Any:
    """The module; raises OptionError, which names the command that installs it, where it is missing."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        extra = EXTRAS[module.partition(".")[0]]
        raise OptionError(
            f'{module} is not installed; pip install "ctr_nlp[{extra}]" brings it ({error})'
        ) from error
