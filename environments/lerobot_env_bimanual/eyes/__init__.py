"""Cameras and printed tags in simulated scenes: pictures, cell files, data sets with videos."""
