"""Tags in pictures, and the poses of what carries them."""
