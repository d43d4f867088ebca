"""Closed loop: plans are corrected while they are played, from sensors. Knows trackers, no device."""
