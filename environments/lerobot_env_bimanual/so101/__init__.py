"""Two SO-101 arms with hobby servos: backlash, sag, joints whose zero is not known."""
