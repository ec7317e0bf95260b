"""Regression measurements: what must not get worse, measured and compared."""
