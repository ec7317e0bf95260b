"""Calibration: a camera's lens by a board, the cell by the robot's own motion."""
