"""From demonstrations to the rows that the mixture is learned from."""
