"""A trained network as arrays: what it gives for a shape, and the file that keeps it."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ctr_nlp.codegen import cache
from ctr_nlp.exceptions import OptionError
from ctr_nlp.robot import Robot
from ctr_nlp.support.atomic_write import write_atomically
from ctr_nlp.typing import Array
from reference.learned.samples import ShapeBatch

FORMAT = 1
"""Format of the file; others are refused."""
NETWORK_CACHE_FOLDER = "s2j"
"""Folder of networks within the cache folder."""


@dataclass(frozen=True)
class InverseKinematicsNetwork:
    """A multilayer perceptron: tanh between its layers, none after the last.

    layers: weights (n_out, n_in) and biases (n_out,). mean (61,), whitening (61, 61): what is subtracted from an
    input, and what it is multiplied by then. curve (k, 3): step of training, mean error of a batch and of held-out
    shapes there, mm. metadata: the format, the model's name, the robot's identity, and how it was trained.
    """

    layers: tuple[tuple[Array, Array], ...]
    mean: Array
    whitening: Array
    curve: Array
    metadata: dict[str, Any]

    def tips(self, shapes: ShapeBatch) -> Array:
        """Angles of tubes at their tips and extensions, (n, 2d), rad and mm, of n shapes.

        The last extension is the shape's length. Nothing keeps extensions within limits.
        """
        turned, angle = shapes.align_with_x()
        value = (turned.network_inputs() - self.mean) @ self.whitening
        for number, (weights, biases) in enumerate(self.layers, start=1):
            value = value @ weights.T + biases
            value = np.tanh(value) if number < len(self.layers) else value
        d = (value.shape[1] + 1) // 3
        cos, sin, parts = np.split(value, [d, 2 * d], axis=1)
        length = shapes.length[:, None]
        return np.hstack([np.arctan2(sin, cos) + angle[:, None], parts * length, length])

    def save(self, path: Path) -> None:
        """Write to a file, whole or not at all; raises OptionError where it cannot be written."""
        arrays = {name: getattr(self, name) for name in ("mean", "whitening", "curve")}
        for number, layer in enumerate(self.layers):
            arrays |= {f"{kind}_{number}": array for kind, array in zip("wb", layer, strict=True)}
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with write_atomically(path) as partial:
                np.savez(partial, told=np.array(json.dumps(self.metadata)), **arrays)
        except OSError as error:
            raise OptionError(f"network {path} cannot be written: {error.strerror}") from error


def read_network(path: Path) -> InverseKinematicsNetwork:
    """Read the network of a file; raises OptionError where it cannot be read or is of another format."""
    try:
        with open(path, "rb") as file, np.load(file, allow_pickle=False) as data:
            told = json.loads(str(data["told"]))
            count = sum(name.startswith("w_") for name in data.files)
            layers = tuple((data[f"w_{k}"], data[f"b_{k}"]) for k in range(count))
            network = InverseKinematicsNetwork(layers, data["mean"], data["whitening"], data["curve"], told)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise OptionError(f"network {path} cannot be read: {error}; train it anew") from error
    if told.get("format") != FORMAT:
        raise OptionError(f"network {path} has the format {told.get('format')}, not {FORMAT}; train it anew")
    return network


def robot_identity(robot: Robot) -> dict[str, Any]:
    """Return the properties of a robot that a network depends on: its tubes' numbers, limits of beta, and carriage
    gap.
    """
    d = robot.d
    beta = [robot.lower[d : 2 * d].tolist(), robot.upper[d : 2 * d].tolist()]
    return {"numbers": robot.numbers.tolist(), "beta": beta, "carriage_gap": robot.carriage_gap}


def network_path(robot: Robot, model: str) -> Path:
    """Return where the network of a robot and a model is kept: in the folder of compiled code (CTR_NLP_CACHE)."""
    digest = hashlib.sha256(json.dumps(robot_identity(robot)).encode()).hexdigest()[:16]
    return cache.folder() / NETWORK_CACHE_FOLDER / f"{model}-{digest}.npz"


def load_trained_network(robot: Robot, model: str) -> InverseKinematicsNetwork:
    """Return the network for a robot and a model; without one raises OptionError, which says how to train it."""
    path = network_path(robot, model)
    if not path.exists():
        others = _describe_other_networks(path, model)
        raise OptionError(
            f"no network has been trained for these {robot.d} tubes on the {model} model{others}; "
            f"`python scripts/studies/learn.py --model {model}` trains it, with --robot for other tubes than the "
            "default ones"
        )
    network = read_network(path)
    if (
        network.metadata["robot"] != json.loads(json.dumps(robot_identity(robot)))
        or network.metadata["model"] != model
    ):
        raise OptionError(f"network {path} is one of another robot or model; train it anew")
    return network


def _describe_other_networks(path: Path, model: str) -> str:
    """Say which networks are there in place of the one at `path`; empty where there are none."""
    known: Sequence[str] = sorted(other.stem.rpartition("-")[0] for other in path.parent.glob("*-*.npz"))
    same = known.count(model)
    if same:
        return f", but for {same} other {'robot' if same == 1 else 'robots'}"
    return f", but on {', '.join(sorted(set(known)))}" if known else ""
