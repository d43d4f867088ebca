"""Training of the S2J-IK network by PyTorch, on shapes that are sampled once.

Liang et al. 2022 (the paper's [7]) is the source of the idea; what differs, and all of it is ours since the
publication was not at hand: a perceptron with tanh, whitened inputs, Adam with a cosine schedule, the loss of
loss.py on simulated shapes (samples.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.models.protocol import Model
from ctr_nlp.robot import Robot
from ctr_nlp.support.extras import import_extra
from ctr_nlp.support.value_checks import whole_number
from ctr_nlp.typing import Array
from reference.learned.loss import ShapeLoss
from reference.learned.network import FORMAT, InverseKinematicsNetwork, robot_identity
from reference.learned.samples import NETWORK_INPUT_SIGMA, ShapeBatch, sample_stable_unknowns, shapes_of

VALIDATION_SHAPE_COUNT = 1000
"""Number of held-out shapes; they are sampled with the training's seed plus 1."""
LEARNING_CURVE_POINTS = 50
"""Number of evaluations on held-out shapes during training, for the learning curve."""
MIN_RELATIVE_INPUT_DEVIATION, INPUT_SCALE_OFFSET = 1e-2, 1e-9
"""Principal components whose standard deviation is less than this part of the largest are not scaled up to 1; and
what is added to the standard deviation of each input, which may be 0."""
INITIAL_LEARNING_RATE = 2e-3
"""Adam's first learning rate, which falls to 0 along half a cosine."""


@dataclass(frozen=True)
class Training:
    """Size of a training: sampled shapes, steps, shapes in a step, widths of hidden layers, and the random seed.

    Raises OptionError where a number is out of its range.
    """

    shapes: int = 50_000
    steps: int = 8_000
    batch: int = 128
    widths: tuple[int, ...] = (256, 256, 256)
    seed: int = 0

    def __post_init__(self) -> None:
        for name, least in (("shapes", 2), ("steps", 1), ("batch", 1), ("seed", 0)):
            whole_number(OptionError, name, getattr(self, name), least)
        for width in self.widths:
            whole_number(OptionError, "a width of training", width)


TrainingProgress = Callable[[int, int, str], None]
"""Called with (steps done, steps in all, error on held-out shapes in words)."""


def train_network(
    robot: Robot,
    model: Model,
    training: Training,
    progress: TrainingProgress | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> InverseKinematicsNetwork:
    """Train the network of a robot on a model; equal seeds give equal networks on the same machine.

    training: its size and seed. progress: called after each step, see TrainingProgress. stop: asked after each
    step; KeyboardInterrupt is raised when it returns True, since half a training is of no use. Raises OptionError
    where the model does not describe the robot or PyTorch is missing.
    """
    torch = import_extra("torch")
    model.check(robot)
    given, held = (
        shapes_of(robot, model, sample_stable_unknowns(robot, model, count, training.seed + k)).align_with_x()[0]
        for k, count in enumerate((training.shapes, VALIDATION_SHAPE_COUNT))
    )
    mean, whitening = _normalisation(given.network_inputs())
    with _seeded_single_thread(torch, training.seed):
        net = _perceptron(torch, training.widths, robot.d)
        inputs = [
            torch.tensor((each.network_inputs() - mean) @ whitening, dtype=torch.float32) for each in (given, held)
        ]
        loss, check = (ShapeLoss(torch, robot, model, count) for count in (training.batch, VALIDATION_SHAPE_COUNT))
        curve = []
        for step, value in _train_steps(torch, net, loss, inputs[0], given, training):
            if stop():
                raise KeyboardInterrupt
            if step % max(1, training.steps // LEARNING_CURVE_POINTS) == 0 or step == training.steps:
                with torch.no_grad():
                    curve.append((step, value, check(net(inputs[1]), held).item()))
            if progress is not None:
                known = f"{curve[-1][2]:.3g} mm off held-out shapes" if curve else "training"
                progress(step, training.steps, known)
        arrays = [parameter.detach().numpy().astype(float) for parameter in net.parameters()]
    told = {"format": FORMAT, "model": model.name, "robot": robot_identity(robot), **asdict(training)}
    return InverseKinematicsNetwork(
        tuple(zip(arrays[::2], arrays[1::2], strict=True)), mean, whitening, np.array(curve), told
    )


def _train_steps(
    torch: Any, net: Any, loss: ShapeLoss, inputs: Any, shapes: ShapeBatch, training: Training
) -> Iterator[tuple[int, float]]:
    """Train net step by step; yields the number of each step, from 1, and the loss before it, mm.

    inputs: whitened inputs (n, 61) of the shapes, a tensor.
    """
    rng = np.random.default_rng(training.seed)
    optimiser = torch.optim.Adam(net.parameters(), lr=INITIAL_LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, training.steps)
    for step in range(1, training.steps + 1):
        some = rng.integers(len(inputs), size=training.batch)
        value = loss(net(inputs[some]), shapes[some])
        optimiser.zero_grad()
        value.backward()
        optimiser.step()
        schedule.step()
        yield step, value.item()


def _normalisation(inputs: Array) -> tuple[Array, Array]:
    """Compute the mean (61,) of inputs (n, 61) and the whitening matrix (61, 61).

    Inputs less the mean, times the matrix, are uncorrelated and have the standard deviation 1, or less where
    MIN_RELATIVE_INPUT_DEVIATION limits it.
    """
    mean = inputs.mean(axis=0)
    scale = inputs.std(axis=0) + INPUT_SCALE_OFFSET
    # The points where tubes end differ little between shapes; unscaled they would hardly count beside the large
    # deflections. The floor keeps components that are rounding from being scaled up, too.
    variances, axes = np.linalg.eigh(np.cov((inputs - mean) / scale, rowvar=False))
    deviations = np.sqrt(np.maximum(variances, variances[-1] * MIN_RELATIVE_INPUT_DEVIATION**2))
    return mean, axes / scale[:, None] / deviations


@contextmanager
def _seeded_single_thread(torch: Any, seed: int) -> Iterator[None]:
    """Run torch with a seed and a single thread within the block.

    Sums over several threads differ in their last digits from run to run.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            yield
    finally:
        torch.set_num_threads(threads)


def _perceptron(torch: Any, widths: tuple[int, ...], d: int) -> Any:
    """Build the layers of an InverseKinematicsNetwork of d tubes, initialised by torch's defaults."""
    layers: list[Any] = []
    before = 3 * len(NETWORK_INPUT_SIGMA) + 1
    for width in widths:
        layers += [torch.nn.Linear(before, width), torch.nn.Tanh()]
        before = width
    return torch.nn.Sequential(*layers, torch.nn.Linear(before, 3 * d - 1))
