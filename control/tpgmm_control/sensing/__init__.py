"""Readings of a running skill: which are used, filtered, and when they are too old."""
