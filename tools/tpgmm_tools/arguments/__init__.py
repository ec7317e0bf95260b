"""Options, help and choices that the commands share."""
