"""MATLAB files of version 7, which MATLAB, Octave, Julia and scipy read: write plans, read variables of others."""

from __future__ import annotations

import io
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat, savemat

from ctr_nlp.exceptions import OptionError, escape_control_characters
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.measures import e3
from ctr_nlp.plan.metrics import by_frame
from ctr_nlp.plan.plan import Plan
from ctr_nlp.plan.simulation import Simulator

MAT_SIGNATURE = "MATLAB 5.0 MAT-file, a plan of ctr_nlp"
HEADER = 116
"""Bytes of descriptive text at the beginning of such a file."""
README = {
    "time": "(T x 1) s, of every frame; frames are evenly spaced, and the first is one step after 0",
    "q": "(T x 2d+2) configurations: alpha_1..d rad, beta_1..d mm, theta_x, theta_y rad; tube 1 is the outermost. "
    "alpha_i is the absolute angle of tube i at its actuated end about +z, beta_i its length beyond the insertion "
    "point",
    "q_names": "(2d+2) names of the columns of q",
    "unknowns": "(T x n) unknowns of the model's equilibria at q: on the elastic model angles of tubes in rad at "
    "their own tips instead of alpha, then beta and theta; on the dominant model q",
    "sigma": "(101 x 1) part of the length up to each point, from 0 at the base to 1 at the tip",
    "shape": "(T x 101 x 3) mm, points of the robot at sigma, in its base frame: origin at the insertion point, "
    "+z the insertion direction; NaN where a frame was never reached",
    "target": "(T x 101 x 3) mm, points of the target at the same sigma",
    "success": "(T x 1) 1 where the frame was solved",
    "stability": "(T x 1) margin, from 0 (snap) to 1; NaN on the dominant model",
    "e2": "(T x 1) mm, root mean square distance of shape and target at equal sigma",
    "e3": "mm, root mean square of e2 over the frames; empty where it is not known",
    "to_robot": "(4 x 4) from the coordinates of the path's file, in mm, to the robot's base frame",
    "space": "coordinates of that file: LPS, RAS or LAS, xyz where it does not say, empty where there is no file",
    "robot": "a struct array, a tube an element, the outermost first: length, curved_length mm; curvature 1/mm, "
    "one number or [root tip]; outer_diameter, inner_diameter mm; poisson_ratio; youngs_modulus in MPa, or "
    "relative; pre_torsion rad/mm; max_strain, a part, NaN of nitinol",
    "q_limits": "(2 x 2d+2) least and largest q",
    "problem": "name of the problem",
    "model": "name of the model that shapes and stability are those of",
}
"""What the variables of the file are, by name; also written into the file."""


def encode_mat(plan: Plan) -> bytes:
    """Return the bytes of a .mat file of `plan`: q, unknowns, shapes, targets, times, errors, robot, explained in
    README.
    """
    found = _contents(plan)
    told = "\n".join(f"{name}: {README[name]}" for name in found)
    buffer = io.BytesIO()
    text = f"A plan of ctr_nlp. T frames, d tubes; mm, rad and s.\n{told}\n"
    savemat(buffer, {"README": text} | found, do_compression=True, long_field_names=True, oned_as="column")
    # scipy writes platform and date into the text of the header; in their place, the signature makes a file of
    # ours recognisable, and the same plan the same bytes.
    return MAT_SIGNATURE.ljust(HEADER).encode() + buffer.getvalue()[HEADER:]


def _contents(plan: Plan) -> dict[str, Any]:
    """Return the variables of a plan's file by name, as README explains them."""
    problem = plan.meta["problem"]
    robot = plan.robot
    error = e3(plan)
    tubes = [{key: np.array(value, float) for key, value in asdict(tube).items()} for tube in robot.tubes]
    struct = np.array([tuple(tube.values()) for tube in tubes], dtype=[(key, object) for key in tubes[0]])
    return {
        "time": plan.time,
        "q": plan.q,
        "q_names": np.array(robot.axes, dtype=object),
        "unknowns": Simulator(robot, plan.evaluated_model)(plan.q).x,
        "sigma": SIGMA_GRID,
        "shape": plan.shape,
        "target": plan.target,
        "success": plan.success.astype(float),
        "stability": plan.stability,
        "e2": by_frame(plan)["e2"],
        "e3": np.empty((0, 0)) if error is None else error,
        "to_robot": plan.to_robot,
        "space": problem.get("space") or "",
        "robot": struct,
        "q_limits": np.stack([robot.lower, robot.upper]),
        "problem": escape_control_characters(problem["name"]),
        "model": plan.evaluated_model_name,
    }


def read_mat_variables(path: Path, wanted: str, structs: bool = False) -> dict[str, Any]:
    """Return the variables in a .mat file by name.

    path: the file. wanted: name of the variable that is needed, for messages. structs: whether structs become
    tables, and arrays lose axes of one entry. Raises OSError where the file cannot be opened, and OptionError
    where its contents cannot be read.
    """
    with open(path, "rb") as file:
        try:
            held = loadmat(file, simplify_cells=structs)
        except NotImplementedError as error:
            raise OptionError(
                f"it is of MATLAB's version 7.3; save it with save(file, '{wanted}', '-v7')"
            ) from error
        except Exception as error:  # whatever scipy's reader meets in a damaged file
            raise OptionError(f"it is damaged, or no file of MATLAB: {error}") from error
    return {name: value for name, value in held.items() if not name.startswith("__")}
