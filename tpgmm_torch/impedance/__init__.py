"""From how well a motion is known to how firmly it is followed."""
