"""Playing a trajectory on a device: supervised, resumed, retracted, trusted. Knows no kind of device."""
