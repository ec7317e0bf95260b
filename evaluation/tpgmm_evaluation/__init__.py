"""Policies trained on the same episodes and rolled out on the same seeds, in one table."""
