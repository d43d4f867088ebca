"""What the emulated firmware's motors do: planned blocks, segments, overrides. Knows no text."""
