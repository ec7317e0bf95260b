"""Bounded motions: followers of references, and braking."""
