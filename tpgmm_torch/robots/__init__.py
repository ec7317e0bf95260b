"""Robots and other sources of link poses and Jacobians."""
