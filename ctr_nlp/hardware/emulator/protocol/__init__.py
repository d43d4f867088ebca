"""What the emulated firmware reads and writes: lines, G-code, its settings, reports. Moves nothing."""
