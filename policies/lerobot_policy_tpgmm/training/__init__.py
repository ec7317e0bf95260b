"""Training by ``lerobot-train``: demonstrations gathered, losses reported, the model fitted."""
