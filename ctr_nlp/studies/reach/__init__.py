"""Reach of robots in a tree: every end planned for every robot, with what keeps it from being reached."""
