"""Many robots at once: equilibria, shapes and margins at rest, by compiled code with a robot in each lane.

Motions of many robots are simulated by sample_motions.simulate_samples, on the same compiled code.
"""

from __future__ import annotations

import ctypes
import ctypes.util

import numpy as np

from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.models import Model, model_named
from ctr_nlp.models.protocol import RestStates
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.robot import Robot
from ctr_nlp.robot.robot import configuration
from ctr_nlp.robot.samples import RobotSamples
from ctr_nlp.support.extras import import_extra
from ctr_nlp.support.threads import count_threads
from ctr_nlp.support.value_checks import check_choice, check_instance
from ctr_nlp.typing import Array

DEVICES = "cpu", "cuda"
"""Names of the devices that a batch may ask for."""
CUDA_DRIVER_LIBRARY = "cuda"
"""Name of the library of NVIDIA's driver, by which a machine with a card is known."""


def batch(
    robot: Robot | RobotSamples,
    q: Array,
    sigma: Array = SIGMA_GRID,
    *,
    model: str | Model = "elastic",
    device: str = "cpu",
    threads: int | None = None,
) -> RestStates:
    """Compute shapes with stability margins of robots at rest, for any number of configurations in one call.

    Every robot is turned to its configuration from aligned tubes, as one that has no history. Motions with a
    history are simulated by :func:`simulate_samples`.

    Parameters
    ----------
    robot : Robot or RobotSamples
        One robot for all configurations, or samples: one for each configuration.
    q : (n, 2d + 2) array
        Configurations (alpha_1..d, beta_1..d, theta_x, theta_y); rad, mm and rad.
    sigma : (m,) array
        Arc lengths as parts of beta_d, in [0, 1]; by default 101 even ones.
    model : str or Model
        Kinematic model; the elastic one computes batches.
    device : str
        ``"cpu"``. ``"cuda"``, a graphics card, raises an error that says what is missing.
    threads : int, optional
        Number of threads that share the work; by default that of ``OMP_NUM_THREADS``, or else one for each core.
        The result does not depend on it.

    Returns
    -------
    RestStates
        Points (n, m, 3) in mm, stability margins (n,), directions of the tips (n, 3), unknowns of the model, and
        ``is_solved`` (n,); NaN where no equilibrium is found.

    Raises
    ------
    RobotError
        `robot` is no robot, `q` is no array of such rows, or samples are not as many as rows.
    OptionError
        The model or device cannot be used, or `sigma` or `threads` is out of its range.

    Examples
    --------
    >>> import numpy as np
    >>> import ctr_nlp as ctr
    >>> q = np.array([[0.0, 0.0, 0.0, 40.0, 90.0, 150.0, 0.0, 0.0], [0.0, 2.5, 0.0, 40.0, 90.0, 150.0, 0.0, 0.0]])
    >>> found = ctr.batch(ctr.table_i_robot(), q)
    >>> found.points.shape, found.is_solved.tolist(), found.margins.round(2).tolist()
    ((2, 101, 3), [True, True], [1.0, 0.99])
    """
    check_instance(RobotError, "robot", robot, Robot, RobotSamples)
    described = model_named(model)
    check_device(device)
    d = robot.structure.d
    q = configuration("q", q)
    if q.ndim != 2 or q.shape[1] != 2 * d + 2:
        raise RobotError(
            f"q has shape {q.shape}; it must be (n, {2 * d + 2}): angles and extensions of {d} tubes, and the tilt"
        )
    sigma = np.asarray(sigma, dtype=float)
    if sigma.ndim != 1 or not ((sigma >= 0) & (sigma <= 1)).all():
        raise OptionError(
            f"sigma has shape {sigma.shape}, from {np.min(sigma, initial=0):g} to {np.max(sigma, initial=0):g}; "
            "it must be a row of parts of the robot's length, in [0, 1]"
        )
    if isinstance(robot, Robot):
        described.check(robot)
        numbers = robot.numbers[None]
    else:
        numbers = robot.numbers
        if len(numbers) != len(q):
            raise RobotError(f"robot has {len(numbers)} samples and q {len(q)} rows; give a row for each sample")
        if robot.forces.any():
            raise RobotError("robot has tip forces, which a batch at rest leaves out; use simulate_samples")
        # A motor's zero is off by the offset; backlash is not taken up at rest.
        q = q + np.pad(robot.offsets, ((0, 0), (0, d + 2)))
    return described.rest_batch(robot.structure, numbers, q, sigma, count_threads(threads))


def check_device(device: str) -> None:
    """Raise OptionError where a device of DEVICES cannot be used, saying what is missing."""
    check_choice("device", device, DEVICES)
    if device == "cpu":
        return
    import_extra("nvidia.cuda_nvrtc")
    if ctypes.util.find_library(CUDA_DRIVER_LIBRARY) is None:
        raise OptionError("device is 'cuda', and this machine has no driver of an NVIDIA graphics card; use 'cpu'")
    raise OptionError(
        "device is 'cuda'; this version builds programs for graphics cards and does not run them; use 'cpu'"
    )
