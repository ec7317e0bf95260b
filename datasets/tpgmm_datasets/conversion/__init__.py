"""From recorded columns to joints, poses and time."""
