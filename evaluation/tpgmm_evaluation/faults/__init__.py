"""Random plants and faults: whether a controller stays within bounds, ends, and says so."""
