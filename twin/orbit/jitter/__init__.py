"""Jitter found in what the lines of a camera saw one after the other."""
