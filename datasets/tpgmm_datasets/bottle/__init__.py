"""The paper's experiment: a bottle is grasped and shaken."""
