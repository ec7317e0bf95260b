"""How to get to what is wanted: motions within bounds on speed, acceleration and jerk."""
