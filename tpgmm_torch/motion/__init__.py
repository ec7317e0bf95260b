"""Motions to wanted postures within bounds on speed, acceleration and jerk."""
