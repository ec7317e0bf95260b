"""A humanoid that grasps and shakes a bottle."""
