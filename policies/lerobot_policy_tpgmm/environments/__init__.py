"""Simulated robots to run policies on, registered with gymnasium and LeRobot."""
