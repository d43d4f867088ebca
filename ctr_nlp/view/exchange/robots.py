"""Read robots from files: of this library, or tubes in SI units in the vocabulary of two families of other
programs.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ctr_nlp.exceptions import OptionError, RobotError
from ctr_nlp.robot import Robot, Tube
from ctr_nlp.support.value_checks import check_choice, checked_path, number, read_toml
from ctr_nlp.view.exchange.mat import read_mat_variables

OWN_ROBOT_SUFFIX, FOREIGN_ROBOT_SUFFIXES = ".toml", (".json", ".mat")
READABLE_ROBOT_FILES = "robot files of ctr_nlp (.toml), and tubes as MexLib or gym-ctr have them (.json, .mat)"
"""Files that can be read, as messages list them."""
ROBOT_FILE_MM_PER_M, ROBOT_FILE_M_PER_MM, ROBOT_FILE_MPA_PER_PA = 1e3, 1e-3, 1e-6
"""Factors that turn lengths in m, curvatures in 1/m and moduli in Pa into mm, 1/mm and MPa."""
DEEPEST = 20
"""Depth to which nested tables are searched for tubes."""


@dataclass(frozen=True)
class TubeVocabulary:
    """Names that a family of programs gives to the numbers of a tube.

    program: which programs, for messages. curved, straight: name of the pre-curved length, or of the straight
    length before it; one of the two is empty. curvatures: names of the pre-curvature about x, and about y where
    there is one.
    """

    program: str
    outer_diameter: str
    inner_diameter: str
    length: str
    youngs_modulus: str
    shear_modulus: str
    curvatures: tuple[str, ...]
    curved: str = ""
    straight: str = ""

    @property
    def required_names(self) -> tuple[str, ...]:
        """Names of all the numbers that a tube must have."""
        sizes = (self.outer_diameter, self.inner_diameter, self.length, self.curved or self.straight)
        return (*sizes, *self.curvatures, self.youngs_modulus, self.shear_modulus)


TUBE_VOCABULARIES = (
    TubeVocabulary("MexLib", "OD", "ID", "L", "E", "G", ("k",), straight="Lt"),
    TubeVocabulary(
        "gym-ctr",
        "diameter_outer",
        "diameter_inner",
        "length",
        "stiffness",
        "torsional_stiffness",
        ("x_curvature", "y_curvature"),
        curved="length_curved",
    ),
)
"""MexLib is the concentric tube library of Gilbert, Rucker and Webster (Vanderbilt, for MATLAB); gym-ctr is the
environment of Iyengar and Stoyanov (Deep reinforcement learning for concentric tube robot control, ICRA 2021).
"""


@dataclass(frozen=True)
class ImportedRobot:
    """Robot that was read from a file, and how the file names its tubes and measures their angles.

    names (d,): the file's names of the tubes, the outermost first. alpha_offsets (d,): alpha less the file's
    angle, rad. A lone tube with alpha = 0 bends towards +x here; in other programs it bends about x, or about the
    axis that its two curvatures give. own: whether the file is one of this library, whose configurations need no
    conversion.
    """

    robot: Robot
    names: tuple[str, ...]
    alpha_offsets: tuple[float, ...]
    own: bool = False

    def to_toml(self, source: str) -> str:
        """Return the text of a robot file, with comments on how to convert the file's configurations; source: the
        file's name.
        """
        if self.own:
            return self.robot.to_toml(f"A robot from {source}.")
        rows = [
            f"Tube {i} is called {name} there. Its angle there {angle:+.4f} rad is alpha_{i}, and the position of "
            f"its base there (negative) + {tube.length:g} mm is beta_{i}."
            for i, (name, angle, tube) in enumerate(
                zip(self.names, self.alpha_offsets, self.robot.tubes, strict=True), start=1
            )
        ]
        return self.robot.to_toml("\n".join([f"A robot from {source}. Lengths in mm, moduli in MPa.", *rows]))


def read_robot(path: str | Path, name: str | None = None, poisson_ratio: float | None = None) -> ImportedRobot:
    """Read the robot in a file, of this library or of another program.

    Parameters
    ----------
    path : str or Path
        A robot file of this library (.toml), with its own limits and tolerances; or a .json or .mat file of
        another program, whose robot gets the limits and tolerances that `Robot` has by default. There a tube is a
        table with the words of one of `TUBE_VOCABULARIES`, with lengths and diameters in m, curvatures in 1/m and
        moduli in Pa, and a robot is a table or a list of such tubes, in any order.
    name : str, optional
        Name of the robot, where a file of another program contains several.
    poisson_ratio : float, optional
        Poisson ratio of every tube, in place of the file's. Some published tables have moduli that no isotropic
        tube has.

    Returns
    -------
    ImportedRobot
        The robot, and how the file names its tubes and measures their angles.

    Raises
    ------
    OptionError
        The file cannot be read, or holds no robot.
    RobotError
        Tubes that cannot be, or a robot file of this library with a mistake.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> ctr.read_robot("robot.toml").robot  # doctest: +SKIP
    """
    path = checked_path(OptionError, path)
    if path.suffix.lower() == OWN_ROBOT_SUFFIX:
        return _read_own_robot(path, name, poisson_ratio)
    if path.suffix.lower() not in FOREIGN_ROBOT_SUFFIXES:
        raise OptionError(
            f"robot file {path} is in no known kind of file; its name must end in .toml, .json or .mat. "
            f"Read are {READABLE_ROBOT_FILES}"
        )
    try:
        robots = dict(_robots(_read(path), path.stem))
        return _build_imported_robot(_select_robot(robots, name), poisson_ratio)
    except OSError as error:
        raise OptionError(f"robot file {path} cannot be read: {error}. Read are {READABLE_ROBOT_FILES}") from error
    except (OptionError, RobotError) as error:
        raise type(error)(f"robot file {path}: {error}") from error


def _read_own_robot(path: Path, name: str | None, poisson_ratio: float | None) -> ImportedRobot:
    """Read the robot from a robot file of this library; name and poisson_ratio as read_robot."""
    if name is not None:
        raise OptionError(f"robot file {path} holds one robot, without a name; leave out name ({name!r})")
    try:
        data = read_toml(path)
        if "tubes" not in data:
            raise RobotError("it holds no tubes, [[tubes]]")
    except RobotError as error:
        raise OptionError(f"robot file {path}: {error}. Read are {READABLE_ROBOT_FILES}") from error
    try:
        robot = Robot.from_dict(data)
        if poisson_ratio is not None:
            robot = replace(robot, tubes=tuple(replace(tube, poisson_ratio=poisson_ratio) for tube in robot.tubes))
    except RobotError as error:
        raise RobotError(f"robot file {path}: {error}") from error
    names = tuple(f"tube {i}" for i in range(1, robot.d + 1))
    return ImportedRobot(robot, names, (0.0,) * robot.d, own=True)


def _read(path: Path) -> Any:
    if path.suffix.lower() == ".mat":
        return read_mat_variables(path, "tubes", structs=True)
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise OptionError(
            f"it is damaged, or of another kind: {error}. Read are {READABLE_ROBOT_FILES}"
        ) from error


def _robots(data: Any, name: str, depth: int = 0) -> Iterator[tuple[str, dict[str, Mapping[str, Any]]]]:
    """Yield the name of each robot in the data of a file, and its tubes by name; searches nested tables."""
    if depth > DEEPEST:
        raise OptionError(f"it holds tables within tables, more than {DEEPEST} deep")
    if not isinstance(data, Mapping):
        data = {str(i): each for i, each in enumerate(data, start=1)} if _is_list(data) else {}
    tubes = {str(key): each for key, each in data.items() if isinstance(each, Mapping) and _find_vocabulary(each)}
    if tubes:
        yield name, tubes
    for key, each in data.items():
        if key not in tubes:
            yield from _robots(each, str(key), depth + 1)


def _is_list(data: Any) -> bool:
    """Tell whether something is a list, of Python or of MATLAB."""
    return isinstance(data, list) or (hasattr(data, "dtype") and data.dtype == object and data.ndim == 1)


def _find_vocabulary(tube: Mapping[str, Any]) -> TubeVocabulary | None:
    """Return the vocabulary of which a table has most names, at least half; None where it has fewer."""
    shares = [
        sum(word in tube for word in words.required_names) / len(words.required_names)
        for words in TUBE_VOCABULARIES
    ]
    # Half of the names are enough, so that a tube with a missing one is reported by that name and not passed over.
    return TUBE_VOCABULARIES[shares.index(max(shares))] if max(shares) >= 0.5 else None


def _select_robot(
    robots: dict[str, dict[str, Mapping[str, Any]]], name: str | None
) -> dict[str, Mapping[str, Any]]:
    if not robots:
        known = "; or ".join(f"{', '.join(words.required_names)} ({words.program})" for words in TUBE_VOCABULARIES)
        raise OptionError(f"it holds no tubes; a tube is a table with {known}. Read are {READABLE_ROBOT_FILES}")
    if name is None and len(robots) > 1:
        raise OptionError(f"it holds several robots, {', '.join(robots)}; give the name of one")
    name = next(iter(robots)) if name is None else name
    check_choice("name of a robot", name, robots)
    return robots[name]


def _build_imported_robot(tubes: dict[str, Mapping[str, Any]], poisson_ratio: float | None) -> ImportedRobot:
    """Make the robot from tubes by name, sorted by outer diameter; poisson_ratio: of every tube, None for the
    file's.
    """
    made = {name: _tube(name, tube, poisson_ratio) for name, tube in tubes.items()}
    names = sorted(made, key=lambda name: -made[name][0].outer_diameter)
    return ImportedRobot(
        Robot(tuple(made[name][0] for name in names)), tuple(names), tuple(made[name][1] for name in names)
    )


def _tube(name: str, given: Mapping[str, Any], poisson_ratio: float | None) -> tuple[Tube, float]:
    """Return the tube of a table, and alpha less the table's angle, rad."""
    words = _find_vocabulary(given)
    assert words is not None

    def value(word: str) -> float:
        if word not in given:
            raise OptionError(f"{word} of tube {name!r} is missing; needed are {', '.join(words.required_names)}")
        return number(OptionError, f"{word} of tube {name!r}", given[word], math.isfinite, "be a finite number")

    about_x, about_y = (*map(value, words.curvatures), 0.0)[:2]
    modulus = value(words.youngs_modulus)
    length = value(words.length)
    curved = value(words.curved) if words.curved else length - value(words.straight)
    if poisson_ratio is None:
        poisson_ratio = _poisson_ratio(name, modulus, value(words.shear_modulus))
    curvature = math.hypot(about_x, about_y)
    try:
        tube = Tube(
            length=_round_converted(ROBOT_FILE_MM_PER_M * length),
            curved_length=_round_converted(ROBOT_FILE_MM_PER_M * curved),
            curvature=_round_converted(ROBOT_FILE_M_PER_MM * curvature),
            outer_diameter=_round_converted(ROBOT_FILE_MM_PER_M * value(words.outer_diameter)),
            inner_diameter=_round_converted(ROBOT_FILE_MM_PER_M * value(words.inner_diameter)),
            poisson_ratio=poisson_ratio,
            youngs_modulus=_round_converted(ROBOT_FILE_MPA_PER_PA * modulus),
        )
    except RobotError as error:
        raise RobotError(f"tube {name!r}, in {words.program}'s m, 1/m and Pa: {error}") from error
    # A curvature about the axis at the angle a from x bends a tube towards a - pi/2: about +y towards +x, which is
    # alpha = 0 here.
    turned = math.atan2(about_y, about_x) - math.pi / 2 if curvature else 0.0
    return tube, math.remainder(turned, 2 * math.pi)


def _poisson_ratio(name: str, modulus: float, shear: float) -> float:
    """Return E / 2G - 1 of Young's modulus `modulus` and shear modulus `shear`, Pa; raise OptionError where no
    isotropic tube has it.
    """
    ratio = modulus / (2 * shear) - 1 if shear > 0 else math.inf
    # A modulus of G = E / 3 that was rounded gives a ratio a little above 1/2.
    if not -1 < ratio <= 0.5 + 1e-9:
        raise OptionError(
            f"tube {name!r} has a Young's modulus of {modulus:g} Pa and a shear modulus of {shear:g} Pa, which is "
            f"a Poisson ratio of {ratio:.3g}; it must lie in (-1, 0.5]; give a Poisson ratio in place of it"
        )
    return min(_round_converted(ratio), 0.5)


def _round_converted(value: float) -> float:
    """Round a number to twelve digits, since converting its unit leaves errors behind them."""
    return float(f"{value:.12g}")
