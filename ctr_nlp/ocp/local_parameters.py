"""Parameters of a program that are valid near one configuration only, and their source for run.c."""

from __future__ import annotations

from typing import NamedTuple


class LocalParameterSource(NamedTuple):
    """The source of parameters that are valid near a configuration only, for run.c.

    The program's last unknown is a slack. call, context: addresses of a function of C and of its first argument;
    it then takes x, the parameter named load_parameter if the program has it, and room for the one named
    wall_parameter followed by the slack needed there, mm. Slack costs weight_parameter a mm, mm^2, and
    excess_factor times as much beyond allowed_parameter, mm, rounded over excess_rounding_mm, and
    slack_square_cost a mm^2. A frame is solved again around its solution until that needs the same slack within
    slack_tolerance_mm, or max_rounds times.
    """

    call: int
    context: int
    load_parameter: str
    wall_parameter: str
    weight_parameter: str
    allowed_parameter: str
    slack_square_cost: float
    excess_factor: float
    excess_rounding_mm: float
    slack_tolerance_mm: float
    max_rounds: int
