"""Frames, demonstrations, situations and trajectories: input and output of a model."""
