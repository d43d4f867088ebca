"""The problems that lead to the ends of a tree, for designs of tubes."""

from __future__ import annotations

from ctr_nlp.anatomy.lumen_tree import LumenTree
from ctr_nlp.exceptions import ProblemError
from ctr_nlp.paths.problem import Problem
from ctr_nlp.robot import Robot
from ctr_nlp.studies.reach.outcomes import UNPLANNED, outcome_before_planning


def end_problems(
    tree: LumenTree,
    robot: Robot,
    frames: int = 100,
    duration: float = 10.0,
    *,
    trim: bool = False,
    smoothing: float | None = None,
) -> list[Problem]:
    r"""Make the problem of advancing to each end of a tree that a robot can be planned to.

    Parameters
    ----------
    tree : LumenTree
        The tree.
    robot : Robot
        The robot; ends that are too narrow for it or too far away are left out.
    frames : int
        Number of frames of each motion.
    duration : float
        Time for all of them, s.
    trim : bool
        Whether the robot's base is moved inwards where a path is longer than it reaches.
    smoothing : float, optional
        How far the followed curves may be from the paths, mm; as in :meth:`LumenTree.problem`.

    Returns
    -------
    list of Problem
        In the order of the ends.

    Raises
    ------
    ProblemError
        No end is left.

    Examples
    --------
    A straight lumen has one end:

    >>> import tempfile
    >>> from pathlib import Path
    >>> import ctr_nlp as ctr
    >>> from ctr_nlp.anatomy.lumen_tree import read_lumen_tree
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder, "line.csv")
    ...     rows = [f"0,0,{z},6" for z in range(0, 41, 5)]
    ...     _ = file.write_text("\n".join(["x_mm,y_mm,z_mm,radius_mm", *rows]))
    ...     tree = read_lumen_tree(file)
    >>> [problem.name for problem in end_problems(tree, ctr.table_i_robot(), frames=10)]
    ['line 1']
    """
    known = [outcome_before_planning(tree, end, "", robot, trim) for end in tree.ends]
    found = [
        tree.problem(one.end, robot, frames, duration, trim=trim, smoothing=smoothing)
        for one in known
        if one.outcome == UNPLANNED
    ]
    if not found:
        why = next((one.reason for one in known), "the tree has no ends")
        raise ProblemError(f"{tree.name} has no end that the robot can be planned to; the first of them: {why}")
    return found
