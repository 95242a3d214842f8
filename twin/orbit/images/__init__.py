"""Pushbroom images of the ground, points measured in them, and the command that records them."""
