"""What ``lerobot-train`` drives: demonstrations gathered, losses reported, the model fitted."""
