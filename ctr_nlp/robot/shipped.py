"""Robot files, robots that come with the package, made for airways, and folders of robot files."""

from __future__ import annotations

from pathlib import Path

from ctr_nlp.exceptions import RobotError, suggest_names
from ctr_nlp.robot.robot import Robot

SHIPPED_ROBOTS_FOLDER = Path(__file__).with_name("robots")
"""Folder of the robot files that come with the package; each says how it was designed."""


def read_robot_files(folder: str | Path | None = None) -> dict[str, Robot]:
    """Read all robot files of a folder.

    Parameters
    ----------
    folder : str or Path, optional
        The folder; by default that of the robots that come with the package, at most 2.8 mm thick and designed
        for airways.

    Returns
    -------
    dict
        The robots by the names of their files, without ``.toml``, in the order of the names.

    Raises
    ------
    RobotError
        The folder has no robot file, or one of them does not describe a robot.

    Examples
    --------
    >>> import ctr_nlp as ctr
    >>> robots = ctr.read_robot_files()
    >>> max(robot.tubes[0].outer_diameter for robot in robots.values()) <= 2.8
    True
    """
    place = SHIPPED_ROBOTS_FOLDER if folder is None else Path(folder)
    files = sorted(place.glob("*.toml"))
    if not files:
        what = "is no folder" if not place.is_dir() else "has no robot file (.toml)"
        raise RobotError(f"robots is {str(place)!r}, which {what}; `ctr-nlp new robot FILE.toml` writes one")
    return {path.stem: Robot.from_toml(path) for path in files}


def read_robot(name: str | Path) -> Robot:
    """Read a robot from a file, or take one that comes with the package.

    Parameters
    ----------
    name : str or Path
        A file (.toml), or the name of a robot of the package, such as ``stock_1``. A file of that name counts
        first.

    Returns
    -------
    Robot
        The robot.

    Raises
    ------
    RobotError
        There is neither, or the file does not describe a robot.

    Examples
    --------
    >>> from ctr_nlp.robot.shipped import read_robot
    >>> read_robot("stock_1").d
    3
    """
    if Path(name).exists() or Path(name).suffix:
        return Robot.from_toml(name)
    shipped = read_robot_files()
    if str(name) not in shipped:
        raise RobotError(
            f"robot is {str(name)!r}; it must be a robot file (.toml) or one of {', '.join(shipped)}, which come "
            f"with the package{suggest_names(str(name), shipped)}"
        )
    return shipped[str(name)]
