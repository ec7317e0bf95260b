"""Skills: what gives estimates of the joints over time, and wrappers that hold skills."""
