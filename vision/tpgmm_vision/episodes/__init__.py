"""Episodes of LeRobot data sets: their pictures, and the poses of objects in them."""
