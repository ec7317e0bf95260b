"""Training by ``lerobot-train``: demonstrations gathered, and the model fitted."""
