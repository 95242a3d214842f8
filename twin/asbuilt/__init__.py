"""The state of one instrument from everything that was measured on it, and the next move."""
