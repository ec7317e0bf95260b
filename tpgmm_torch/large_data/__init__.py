"""Data larger than memory, and learning by several processes."""
