"""The 50 tasks of Meta-World, observed through states, for any policy of LeRobot."""
