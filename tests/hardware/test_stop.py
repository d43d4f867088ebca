"""How motion behind a Grbl controller is stopped, against a controller whose words are written here."""

import pytest

from ctr_nlp.exceptions import DeviceFault
from ctr_nlp.hardware.devices.grbl.stop import stop_controller
from ctr_nlp.hardware.devices.grbl.talk import GRBL_HOLD, GRBL_RESET, GRBL_STATUS_QUERY, Talk

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
        self.words = {GRBL_HOLD: in_hold, GRBL_RESET: in_reset}

    def write(self, data):
        if GRBL_HOLD in data:
            self.state, self.said = b"<Hold:0|", self.said + self.words.pop(GRBL_HOLD, b"")
        if GRBL_RESET in data:
            self.state, self.said = b"<Idle|", self.said + self.words.pop(GRBL_RESET, b"") + BANNER
        self.said += (self.state + AT) * data.count(GRBL_STATUS_QUERY)

    def read(self):
        said, self.said = self.said, b""
        return said


def stop(controller):
    clock = Clock()
    return stop_controller(Talk(controller, clock), clock)


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


class Jogging(Controller):
    """Has a jog's prepared steps still to make when it is cancelled, for so many s; feed is what it tells then."""

    def __init__(self, clock, seconds, feed):
        super().__init__()
        self.state, self.clock, self.rests, self.feed = b"<Jog|", clock, clock.now() + seconds, feed

    def write(self, data):
        self.clock.sleep(0.02)
        if GRBL_RESET in data or self.clock.now() >= self.rests:
            super().write(data)
        elif GRBL_STATUS_QUERY in data:
            place, feed = b"MPos:%.3f" % (-1.0 - self.rests + self.clock.now()), b"FS:" + self.feed
            self.said += self.state + AT.replace(b"MPos:-1.000", place).replace(b"FS:0", feed)


def test_a_slow_jog_whose_feed_is_0_is_left_its_last_steps():
    """grblHAL stays in state Jog with a feed of 0 for 0.5 s where it jogs at 3 mm/min."""
    clock = Clock()
    assert stop_controller(Talk(Jogging(clock, 0.5, feed=b"0"), clock), clock).position[0] == -1


def test_a_jog_that_goes_on_is_reset_in_motion():
    clock = Clock()
    with pytest.raises(DeviceFault, match="reset in motion"):
        stop_controller(Talk(Jogging(clock, 0.5, feed=b"3"), clock), clock)
