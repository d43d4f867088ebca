"""A trained network as numpy arrays, its evaluation for shapes, and its file.

The network is S2J-IK's (Liang et al. 2022, the paper's [7]) in purpose; its sizes and its layers are ours, since
the publication was not at hand (s2j.py). Angles are output as cosine and sine, as in Grassmann et al., IROS 2018:
an angle itself would jump by 2 pi between shapes that are close to each other. PyTorch is needed for training
only.
"""

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
"""Format number of the file; others are refused."""
NETWORK_CACHE_FOLDER = "s2j"
"""Name of the networks' folder within the cache folder."""


@dataclass(frozen=True)
class InverseKinematicsNetwork:
    """A multilayer perceptron: tanh between its layers, none after the last.

    layers: weights (n_out, n_in) and biases (n_out,). mean (61,), whitening (61, 61): subtracted from an input,
    and multiplied with the difference. curve (k, 3): step of training, mean error of a batch and of held-out
    shapes there, mm. metadata: the format number, the model's name, the robot's identity, and the training's
    settings.
    """

    layers: tuple[tuple[Array, Array], ...]
    mean: Array
    whitening: Array
    curve: Array
    metadata: dict[str, Any]

    def tips(self, shapes: ShapeBatch) -> Array:
        """Evaluate the network: the tubes' angles at their tips and their extensions, (n, 2d), of n shapes.

        Angles are in rad, extensions in mm; the last one is the shape's length. Extensions may be beyond their
        limits.
        """
        # The network knows shapes that are turned towards +x; all its angles are turned back afterwards.
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
        """Write the network to the file at `path`, whole or not at all.

        Raises OptionError where it cannot be written.
        """
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
    """Read the network in the file at `path`; raises OptionError where that fails or the format is another."""
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
    """Return the properties of a robot that a network depends on.

    These are its tubes' numbers, limits of beta, and carriage gap.
    """
    d = robot.d
    beta = [robot.lower[d : 2 * d].tolist(), robot.upper[d : 2 * d].tolist()]
    return {"numbers": robot.numbers.tolist(), "beta": beta, "carriage_gap": robot.carriage_gap}


def network_path(robot: Robot, model: str) -> Path:
    """Return the path of the network's file for a robot and the name of a model, in the folder CTR_NLP_CACHE."""
    digest = hashlib.sha256(json.dumps(robot_identity(robot)).encode()).hexdigest()[:16]
    return cache.folder() / NETWORK_CACHE_FOLDER / f"{model}-{digest}.npz"


def load_trained_network(robot: Robot, model: str) -> InverseKinematicsNetwork:
    """Return the network for a robot and the name of a model.

    Raises OptionError, which says how to train one, where there is none.
    """
    path = network_path(robot, model)
    if not path.exists():
        others = _describe_other_networks(path, model)
        raise OptionError(
            f"no network has been trained for these {robot.d} tubes on the {model} model{others}; "
            f"`python scripts/studies/learn.py --model {model}` trains it, with --robot for other tubes than the "
            "default ones"
        )
    network = read_network(path)
    # The file's name has 64 bits of the digest: compare in full. The metadata has been through JSON, hence the
    # round trip.
    if (
        network.metadata["robot"] != json.loads(json.dumps(robot_identity(robot)))
        or network.metadata["model"] != model
    ):
        raise OptionError(f"network {path} is one of another robot or model; train it anew")
    return network


def _describe_other_networks(path: Path, model: str) -> str:
    """Describe the networks that exist instead of the one at `path`, for a message; empty where there are none."""
    known: Sequence[str] = sorted(other.stem.rpartition("-")[0] for other in path.parent.glob("*-*.npz"))
    same = known.count(model)
    if same:
        return f", but for {same} other {'robot' if same == 1 else 'robots'}"
    return f", but on {', '.join(sorted(set(known)))}" if known else ""
