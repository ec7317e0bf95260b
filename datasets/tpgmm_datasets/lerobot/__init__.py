"""LeRobot's formats on disk, v2.1 and v3.0."""
