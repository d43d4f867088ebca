"""The arm that tilts the robot about the insertion point: what it is, how it moves and may move."""
