"""Two ALOHA arms on state observations."""
