"""Tubes as unknowns that the frames of several tasks have in common, and the rules by which they can be made.

Unknowns p: of every tube its pre-curvature (at the root and at the tip where these differ) in 1/(100 mm), then the
length of its curved part in 100 mm, then its outer and inner diameter in mm; these units make all entries of one
order. Bending stiffnesses follow from diameters and moduli, EI = E pi (D^4 - d^4) / 64. Straight transmissions
keep their lengths, and a tube is pushed out by no more than its curved part.

Strains are those of docs/method.md, "The robot": k D / 2 of a tube bent into its pre-curvature, and D / 2 |k - sum
EI_j k_j / sum EI_j| of one deployed beside others that are all turned alike.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from ctr_nlp.exceptions import OptionError
from ctr_nlp.ocp.nlp import Constraint, CostTerm, Nlp
from ctr_nlp.ocp.scenarios import CommonUnknowns, Scenarios
from ctr_nlp.ocp.shared.manufacture import Manufacture
from ctr_nlp.robot import Robot
from ctr_nlp.robot.structure import TUBE_NUMBER_NAMES, locate_free_numbers
from ctr_nlp.robot.tube import Tube
from ctr_nlp.typing import Array, Index

DESIGN_NUMBER_NAMES = "curvature", "bending_stiffness", "curved_length", "length"
"""Numbers of tubes that a design decides, in the order in which frames take them; area too, where tubes weigh."""
DESIGN_LENGTH_UNIT_MM = 100.0
"""Unit of lengths of curved parts among p, mm, and of radii."""
MIN_CURVED_LENGTH_MM = 10.0
"""Least length of a curved part, mm."""
MIN_TIP_CURVATURE_PER_MM = 1e-4
"""Least curvature at the tip of a curved tube, 1/mm: a straight one is another structure."""
MIN_RELATIVE_CURVATURE_CHANGE = 1e-9
"""Least relative difference of root and tip curvature where the curvature is linear: equal ones are another
structure.
"""
RULE_BOUND_MARGIN = 1e-7
"""Distance from its bounds that a rule keeps, so that rounding does not violate it."""

RULE_VALUE_DECIMALS = 12
"""Digits after the point of rules' values, and of lengths in mm: sums of decimal numbers are off by less."""


class RuleValue(NamedTuple):
    """A rule of manufacture on some tubes: its value, and the bounds between which that must lie."""

    name: str
    value: float
    lower: float
    upper: float


@dataclass(frozen=True)
class DesignedTubes:
    """The tubes of a robot as unknowns p (P,), within rules.

    fixed: names of entries that stay as they are. weighs: whether the tubes' own weight counts. No curved part
    becomes longer than the robot's reach. Raises OptionError where a name is unknown, where no tubes satisfy the
    rules, and where straight parts of tubes can be pushed out, which is another structure.
    """

    robot: Robot
    rules: Manufacture
    fixed: tuple[str, ...] = ()
    weighs: bool = False

    def __post_init__(self) -> None:
        self.rules.check_tubes(self.robot.d)
        # A tube whose straight part shows has more sections; p may change the structure only in numbers.
        if any(self.robot.structure.transmission_emerges):
            raise OptionError(
                "limits of beta let straight transmissions come out; a design needs limits of beta that are at "
                "most the curved lengths"
            )
        for name in self.fixed:
            if name not in self.names:
                raise OptionError(f"{name!r} cannot be fixed; what can be is {', '.join(self.names)}")

    @property
    def free_number_names(self) -> tuple[str, ...]:
        """Names of the tubes' numbers that are unknowns of a frame."""
        return DESIGN_NUMBER_NAMES + ("area",) * self.weighs

    @cached_property
    def _curvatures(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """For each pre-curvature among p, its tube, from 0, and its columns among that tube's numbers."""
        return locate_free_numbers(self.robot.structure, ("curvature",))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of p's entries, with the number of the tube, from 1."""
        kinds = (
            "curvature" if len(columns) > 1 else TUBE_NUMBER_NAMES[columns[0]] for _, columns in self._curvatures
        )
        curvatures = [f"{kind}_{i + 1}" for kind, (i, _) in zip(kinds, self._curvatures, strict=True)]
        tubes = range(1, self.robot.d + 1)
        ends = ("outer_diameter", "inner_diameter")
        return (
            *curvatures,
            *(f"curved_length_{i}" for i in tubes),
            *(f"{end}_{i}" for i in tubes for end in ends),
        )

    @cached_property
    def _at_roots(self) -> Index:
        """Positions in p of curvatures at roots, which may be negative: only the tip's has to be positive."""
        root = (TUBE_NUMBER_NAMES.index("root_curvature"),)
        return np.array([k for k, (_, columns) in enumerate(self._curvatures) if columns == root], dtype=int)

    @cached_property
    def _transmissions(self) -> Array:
        """Lengths (d,) of the straight parts, mm, which a design keeps."""
        return np.array([tube.length - tube.curved_length for tube in self.robot.tubes])

    @cached_property
    def nominal_unknowns(self) -> Array:
        """The p of the robot's own tubes."""
        tubes = self.robot.tubes
        curvatures = [DESIGN_LENGTH_UNIT_MM * self.robot.numbers[i, columns[0]] for i, columns in self._curvatures]
        lengths = [tube.curved_length / DESIGN_LENGTH_UNIT_MM for tube in tubes]
        diameters = [end for tube in tubes for end in (tube.outer_diameter, tube.inner_diameter)]
        return np.array([*curvatures, *lengths, *diameters])

    def robot_of(self, p: Array) -> Robot:
        """Return the robot with the tubes of p (P,), which may be pushed out by all of their curved parts."""
        curvatures, lengths, diameters = self._split(p)
        tubes = list[Tube]()
        for i, (tube, (outer, inner)) in enumerate(zip(self.robot.tubes, diameters.tolist(), strict=True)):
            own = [
                float(curvatures[k]) / DESIGN_LENGTH_UNIT_MM
                for k, (at, _) in enumerate(self._curvatures)
                if at == i
            ]
            bent = (own[0], own[-1]) if own else 0.0
            if len(own) == 2 and own[0] == own[1]:  # the same kind of part, though it happens to be an arc
                bent = (own[0], own[1] * (1 + MIN_RELATIVE_CURVATURE_CHANGE))
            curved = round(DESIGN_LENGTH_UNIT_MM * float(lengths[i]), RULE_VALUE_DECIMALS)
            straight = float(self._transmissions[i])
            whole = straight + curved
            tubes.append(Tube(whole, curved, bent, outer, inner, tube.poisson_ratio, tube.youngs_modulus))
        # Limits of beta follow from the new lengths.
        limits = replace(self.robot.limits, beta=None)
        return replace(self.robot, tubes=tuple(tubes), limits=limits)

    def _split(self, p: Any) -> tuple[Any, Any, Any]:
        """Split p into curvatures (c,), lengths (d,) and diameters (d, 2), in its units."""
        count = len(self._curvatures)
        d = self.robot.d
        diameters = p[count + d :]
        # CasADi fills columns first, numpy rows: p has outer and inner diameter of one tube next to each
        # other.
        shaped = ca.reshape(diameters, 2, d).T if isinstance(p, ca.SX) else diameters.reshape(d, 2)
        return p[:count], p[count : count + d], shaped

    @cached_property
    def box(self) -> tuple[Array, Array]:
        """Lower and upper bounds (P,) of p."""
        count = len(self._curvatures)
        d = self.robot.d
        lower = np.full(len(self.names), self.rules.channel)
        upper = np.full(len(self.names), self.rules.outer)
        # Curvatures are positive, since a negative one is the same tube turned by pi; a root's may have the
        # other sign.
        lower[:count], upper[:count] = (
            DESIGN_LENGTH_UNIT_MM * MIN_TIP_CURVATURE_PER_MM,
            DESIGN_LENGTH_UNIT_MM / self.rules.bend_radius,
        )
        if not self.rules.one_sided:
            lower[self._at_roots] = -DESIGN_LENGTH_UNIT_MM / self.rules.bend_radius
        lower[count : count + d], upper[count : count + d] = (
            np.array([MIN_CURVED_LENGTH_MM, self.robot.reach]) / DESIGN_LENGTH_UNIT_MM
        )
        # The innermost tube's curved part stays as long as the robot's reach.
        lower[count + d - 1] = upper[count + d - 1]
        held = np.array([name in self.fixed for name in self.names])
        return np.where(held, self.nominal_unknowns, lower), np.where(held, self.nominal_unknowns, upper)

    @cached_property
    def program(self) -> Nlp:
        """The program over p: rows with the frames' free numbers, the rules, and a proximal term towards near.

        Parameters: near (P, 1), pull (1, 1) in mm^2 a squared unit.
        """
        p = ca.SX.sym("p", len(self.names))
        curvatures, lengths, diameters = self._split(p)
        curvatures = curvatures / DESIGN_LENGTH_UNIT_MM
        lengths = lengths * DESIGN_LENGTH_UNIT_MM
        outer, inner = ca.horzsplit(diameters)
        whole = lengths + ca.DM(self._transmissions)
        moduli = ca.DM([tube.youngs_modulus for tube in self.robot.tubes])
        # Second moment of area of a ring.
        stiffness = moduli * (math.pi / 64) * (outer**4 - inner**4)
        near = ca.SX.sym("near", p.numel())
        pull = ca.SX.sym("pull")
        areas = (math.pi / 4) * (outer**2 - inner**2)
        # In the order of DESIGN_NUMBER_NAMES, which frames take them in.
        given = ca.vertcat(curvatures, stiffness, lengths, whole, *[areas] * self.weighs)
        free = np.full(given.numel(), np.inf)
        return Nlp(
            "tubes",
            p,
            np.full(p.numel(), -np.inf),
            np.full(p.numel(), np.inf),
            {"near": near, "pull": pull},
            costs=(CostTerm("pull", pull * ca.sumsqr(p - near)),),
            constraints=(
                Constraint("freed", given, -free, free),
                *(_rule_constraint(*rule) for rule in self._rules(curvatures, stiffness, whole, outer, inner)),
            ),
        )

    def _rules(
        self, curvatures: ca.SX, stiffness: ca.SX, lengths: ca.SX, outer: ca.SX, inner: ca.SX
    ) -> list[tuple[str, ca.SX, float, float]]:
        """Return the rules of manufacture: name, value, and lower and upper bound, each."""
        rules = self.rules
        d = self.robot.d
        gap = self.robot.carriage_gap or 0.0
        found = [
            (
                f"strain of tube {i + 1} when made{_end_text(columns)}",
                curvatures[k] * outer[i] / 2,
                -rules.strain_made,
                rules.strain_made,
            )
            for k, (i, columns) in enumerate(self._curvatures)
        ]
        for i in range(d):
            # Thickness of the tube's wall, mm.
            found.append((f"wall of tube {i + 1}", (outer[i] - inner[i]) / 2, rules.wall, math.inf))
        for i in range(d - 1):
            # Difference of diameters: twice the gap on each side.
            between = inner[i] - outer[i + 1]
            found.append((f"clearance of tubes {i + 1} and {i + 2}", between, rules.clearance, math.inf))
            longer = lengths[i + 1] - lengths[i]
            found.append((f"room of the carriages of tubes {i + 1} and {i + 2}", longer, gap, math.inf))
        found.append(("inner channel", inner[d - 1], rules.channel, math.inf))
        own = [
            [curvatures[k] for k, (at, _) in enumerate(self._curvatures) if at == i] or [ca.SX(0)]
            for i in range(d)
        ]
        # Sections of the deployed robot: from the tube `first` inwards all are present, and share one
        # curve.
        for first in range(d - 1):
            inside = range(first, d)
            together = sum(stiffness[i] for i in inside)
            # Linear curvatures are extreme at root or tip; strains are checked at both.
            ends = sorted({0, *(len(each) - 1 for each in own[first:])})
            for end in ends:
                where = "" if len(ends) == 1 else f" at the {'tips' if end else 'roots'}"
                bent = [each[min(end, len(each) - 1)] for each in own]
                common = sum(stiffness[i] * bent[i] for i in inside) / together
                for i in inside:
                    name = f"strain of tube {i + 1} within tubes {first + 1} to {d}{where}"
                    strain = (bent[i] - common) * outer[i] / 2
                    found.append((name, strain, -rules.strain_deployed, rules.strain_deployed))
        return found

    def common(self, scenarios: Scenarios, near: Array, pull: float) -> CommonUnknowns:
        """Return the common unknowns of a shared motion of scenarios: this program, with its proximal term.

        near (P,): towards which p is pulled, by `pull` mm^2 a squared unit.
        """
        places = locate_free_numbers(self.robot.structure, self.free_number_names)
        numbers = scenarios.numbers[:, [i for i, _ in places], [columns[0] for _, columns in places]]
        parameters = self.program.pack({"near": near, "pull": pull})
        # Scenario s has the nominal number times a factor: relative tolerances stay what they are while
        # tubes change.
        return CommonUnknowns(self.program, numbers / numbers[0], parameters, *self.box)

    def rule_values(self, p: Array) -> list[RuleValue]:
        """Return the rules' values and bounds at p (P,)."""
        parameters = self.program.pack({"near": p, "pull": 0.0})
        g = self.program.functions.value(p, parameters)[1].full().ravel()
        found = list[RuleValue]()
        at = 0
        for constraint in self.program.constraints:
            size = constraint.value.numel()
            if constraint.name != "freed":
                bounds = constraint.lower[0] - RULE_BOUND_MARGIN, constraint.upper[0] + RULE_BOUND_MARGIN
                told = (round(float(each), RULE_VALUE_DECIMALS) for each in (g[at], *bounds))
                found.append(RuleValue(constraint.name, *told))
            at += size
        return found

    def satisfies_rules(self, p: Array) -> bool:
        """Return whether the tubes of p (P,) satisfy rules and bounds."""
        lower, upper = self.box
        good = all(rule.lower <= rule.value <= rule.upper for rule in self.rule_values(p))
        return good and bool(((lower <= p) & (p <= upper)).all())


def _end_text(columns: Sequence[int]) -> str:
    """Return the text for the end of a curved part with a pre-curvature, by its columns in TUBE_NUMBER_NAMES.

    Empty for an arc, whose two ends share it.
    """
    return "" if len(columns) > 1 else f" at its {TUBE_NUMBER_NAMES[columns[0]].partition('_')[0]}"


def with_linear_curvatures(robot: Robot) -> Robot:
    """Return the robot with arcs as curved parts of linear curvature, all but constant."""
    tubes = (
        replace(tube, curvature=(tube.root_curvature, tube.tip_curvature * (1 + MIN_RELATIVE_CURVATURE_CHANGE)))
        if kind == "arc"
        else tube
        for tube, kind in zip(robot.tubes, robot.structure.kinds, strict=True)
    )
    return replace(robot, tubes=tuple(tubes))


def _rule_constraint(name: str, value: ca.SX, lower: float, upper: float) -> Constraint:
    """Return a constraint that keeps a rule RULE_BOUND_MARGIN within its bounds."""
    return Constraint(name, value, np.array([lower + RULE_BOUND_MARGIN]), np.array([upper - RULE_BOUND_MARGIN]))
