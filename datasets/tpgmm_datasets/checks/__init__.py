"""Checks of recordings: units, order, clocks, joints, frames, episodes unlike the others."""
