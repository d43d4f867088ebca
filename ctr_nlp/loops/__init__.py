"""Loops that close: a plant, what is measured of it, what is estimated from that, and a motion that is corrected."""
