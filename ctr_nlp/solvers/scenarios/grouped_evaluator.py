"""Values and derivatives of every robot in every frame, each by the cheapest program that gives the same numbers.

Second derivatives take most of the time of a solve, and those of the wall two thirds of them. Robots that the wall
is far from are therefore evaluated without its term, and robots whose errors do not count (which only have to keep
a stability margin) without any term of the objective. Results are those of the whole program. Objectives are in
mm^2, unknowns in rad and mm, a row for every robot of every frame.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ctr_nlp.codegen.batch_evaluator import BatchEvaluator
from ctr_nlp.ocp.scenarios import SharedMotion
from ctr_nlp.typing import Array, Flags, Index

FAR_WALL_COST_MM2 = 1e-3
"""mm^2: the wall is far from a robot where contact costs no more than this, which is at about 3 mm."""


class _Group(NamedTuple):
    """Rows (r,) of robots in frames that share a program, and its functions for these rows."""

    rows: Index
    maps: list[BatchEvaluator]


class GroupedEvaluator:
    """The three functions of a frame's program (ocp.expressions.FrameFunctions), for all rows of a motion.

    Attributes
    ----------
    parameters : ndarray
        Of the whole program, (T S, n_p): a row for every robot of every frame. Call `regroup` after a change.
    """

    def __init__(self, motion: SharedMotion) -> None:
        """Prepare: the wall is taken to be near everywhere."""
        self._motion = motion
        self.parameters = motion.parameters.copy()
        self._counted = np.tile(motion.weights, len(motion.lower)) > 0
        self._far: Flags = np.zeros(len(self.parameters), dtype=bool)
        self.regroup(self._far)

    @property
    def far(self) -> Flags:
        """The rows (T S,) that are evaluated without the wall."""
        return self._far

    def regroup(self, far: Flags) -> None:
        """Take the parameters as they are now, and evaluate the rows that are far from the wall without it.

        Parameters
        ----------
        far : ndarray
            Whether the wall is far from each row, (T S,).
        """
        motion = self._motion
        every = np.arange(self.parameters.shape[1])
        self._far = far
        # Three disjoint kinds of rows: no objective at all, no wall, everything. Rows whose errors do not
        # count do not need the wall.
        bare = np.zeros(len(far), dtype=bool) if motion.without_objective is None else ~self._counted
        free = np.zeros(len(far), dtype=bool) if motion.without_wall is None else far & ~bare
        kinds = [(motion.functions, every, ~(bare | free))]
        kinds += (
            [(motion.without_wall.functions, motion.without_wall.columns, free)]
            if motion.without_wall is not None
            else []
        )
        kinds += (
            [(motion.without_objective.functions, motion.without_objective.columns, bare)]
            if motion.without_objective is not None
            else []
        )
        self._groups = list[_Group]()
        for functions, columns, chosen in kinds:
            rows = np.flatnonzero(chosen)
            if not len(rows):
                continue
            maps = [BatchEvaluator(each, len(rows)) for each in functions()[:3]]
            for each in maps:
                each.inputs[1][:] = self.parameters[np.ix_(rows, columns)]
            self._groups.append(_Group(rows, maps))

    def __call__(self, order: int, x: Array, *multipliers: Array) -> list[Array]:
        """Evaluate the functions with derivatives up to an order.

        Parameters
        ----------
        order : int
            0: objective and rows; 1: their first derivatives too; 2: the Hessian of the Lagrangian too.
        x : ndarray
            Unknowns of every row, (T S, m).
        *multipliers : ndarray
            For order 2: lam_f (T S,) and lam_g (T S, g).

        Returns
        -------
        list of ndarray
            Results, a row each; overwritten by the next call.
        """
        flat = x.reshape(len(self.parameters), -1)
        given = [each.reshape(len(flat), -1) for each in multipliers]
        # All rows in one group keep their order: no copies are needed.
        if len(self._groups) == 1:
            return self._groups[0].maps[order](flat.ravel(), *(each.ravel() for each in given))
        found = list[Array]()
        for group in self._groups:
            own = (each[group.rows].ravel() for each in given)
            results = group.maps[order](flat[group.rows].ravel(), *own)
            # Widths are known from the first group's results; all groups' programs have as many rows and
            # unknowns.
            found = found or [np.empty((len(flat), each.shape[1])) for each in results]
            for whole, part in zip(found, results, strict=True):
                whole[group.rows] = part
        return found

    def contact_costs(self, x: Array) -> Array:
        """Cost of contact of every robot in every frame, with the parameters as they are.

        Parameters
        ----------
        x : ndarray
            Unknowns of every row, (T S, m).

        Returns
        -------
        ndarray
            (T S,), mm^2.
        """
        free = self._motion.without_wall
        flat = x.reshape(len(self.parameters), -1)
        assert free is not None
        found = list[Array]()
        for functions, columns in ((self._motion.functions, slice(None)), (free.functions, free.columns)):
            value = BatchEvaluator(functions()[0], len(flat))
            value.inputs[1][:] = self.parameters[:, columns]
            found.append(value(flat.ravel())[0].ravel().copy())
        # The wall is the only term that the free program lacks.
        return found[0] - found[1]
