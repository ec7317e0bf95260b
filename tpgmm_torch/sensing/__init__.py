"""What a running skill is told, and what it believes of it."""
