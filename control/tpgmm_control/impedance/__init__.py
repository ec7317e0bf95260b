"""Stiffness and damping from the covariance of a motion."""
