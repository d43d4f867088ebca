"""Plans that are corrected while they are played, by what sensors tell of the robot. Knows trackers, no device."""
