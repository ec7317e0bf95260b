"""Who does the tasks of the suite: the upper body, two ViperX arms, a Unitree G1."""
