"""Poses of objects from cameras: printed tags, calibration by the robot itself, tracking."""
