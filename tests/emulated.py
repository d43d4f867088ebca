"""A host of the emulated controller, in virtual time."""

from emulator import Firmware, VirtualClock, Wire


class Host:
    """A host on a wire in virtual time that keeps every line it was sent."""

    def __init__(self, *faults, **settings):
        self.firmware = Firmware(**settings)
        self.clock = VirtualClock()
        self.wire = Wire(self.firmware, self.clock, faults)

    def listen(self, seconds):
        end = self.clock.now() + seconds
        data = b""
        while self.clock.now() < end:
            data += self.wire.read(end - self.clock.now())
        return data.decode("latin-1").replace("\r", "").split("\n")[:-1]

    def ask(self, *lines, seconds=0.05):
        heard = []
        for line in lines:
            self.wire.write(line if isinstance(line, bytes) else line.encode() + b"\n")
            heard += self.listen(seconds)
        return heard

    def settle(self, most=60.0):
        end = self.clock.now() + most
        heard = []
        while self.clock.now() < end:
            heard += self.listen(0.05)
            if self.firmware.state == "Idle":
                return heard
        raise AssertionError(f"still {self.firmware.state} after {most} s")


def program(count, seconds=0.1, step=-0.2):
    return [f"N{i} G1 X{step * i:.4f} A{2 * i:.4f} F{60 / seconds:g}" for i in range(1, count + 1)]
