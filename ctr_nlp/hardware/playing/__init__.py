"""A trajectory played on a device: supervised, resumed, taken back, trusted. Knows no kind of device."""
