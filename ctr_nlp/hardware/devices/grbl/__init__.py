"""Steppers behind a Grbl or grblHAL controller."""
