"""What goes in and what comes out: frames, demonstrations, situations, trajectories."""
