"""Sources of measurements that a hardware file, or an option, names."""

from __future__ import annotations

from ctr_nlp.hardware.sensing.description import Sensing
from ctr_nlp.hardware.sensing.igtl import Igtl
from ctr_nlp.hardware.sensing.lines import JsonLineSource
from ctr_nlp.hardware.sensing.ros2 import Topic
from ctr_nlp.hardware.sensing.simulated import SimulatedRobot
from ctr_nlp.hardware.sensing.source import Remote, Source
from ctr_nlp.plan.plan import Plan

REMOTE: dict[str, type[Remote]] = {"udp": JsonLineSource, "tcp": JsonLineSource, "igtl": Igtl, "ros2": Topic}


def source_of(sensing: Sensing, plan: Plan) -> Source:
    """Return the source of measurements, not open yet.

    sensing: describes it. plan: whose robot a simulated source samples.
    """
    if sensing.address.kind == "simulated":
        return SimulatedRobot(plan, sensing.sensors, int(sensing.address.rest))
    return REMOTE[sensing.address.kind](sensing)
