"""How motion behind a Grbl controller is stopped, against a controller whose words are written here."""

import pytest

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.devices.grbl.stop import stopped
from ctr_nlp.hardware.devices.grbl.talk import HOLD, RESET, STATUS, Talk

BANNER = b"GrblHAL 1.1f ['$' or '$HELP' for help]\r\n"
AT = b"MPos:-1.000,0.000,0.000,0.000,0.000,0.000|Bf:100,1023|FS:0,0>\r\n"


class Clock:
    """Time that passes when one sleeps."""

    def __init__(self):
        self.time = 0.0

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.time += seconds


class Controller:
    """Rests as soon as it is held; says what it is given once, when a hold, or a reset, has come."""

    def __init__(self, in_hold=b"", in_reset=b""):
        self.said, self.state = b"", b"<Run|"
        self.words = {HOLD: in_hold, RESET: in_reset}

    def write(self, data):
        if HOLD in data:
            self.state, self.said = b"<Hold:0|", self.said + self.words.pop(HOLD, b"")
        if RESET in data:
            self.state, self.said = b"<Idle|", self.said + self.words.pop(RESET, b"") + BANNER
        self.said += (self.state + AT) * data.count(STATUS)

    def read(self):
        said, self.said = self.said, b""
        return said


def stop(controller):
    clock = Clock()
    return stopped(Talk(controller, clock), clock)


def test_a_controller_that_says_nothing_else_is_trusted():
    assert stop(Controller()).position[0] == -1


@pytest.mark.parametrize("words", [b"ALARM:1\r\n", BANNER], ids=["alarm", "banner"])
def test_what_is_said_between_the_hold_and_the_reset_is_not_forgotten(words):
    """By then it has stopped itself, or has restarted: its count of steps may be wrong."""
    with pytest.raises(DeviceFault, match=r"the controller said .* before it was stopped"):
        stop(Controller(in_hold=words))


def test_an_alarm_after_the_reset_is_one_of_a_reset_in_motion():
    with pytest.raises(DeviceFault, match="reset in motion"):
        stop(Controller(in_reset=b"ALARM:3\r\n"))
