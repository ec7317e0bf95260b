"""From one reference to a motion: the closed loop, for one robot or thousands."""
