"""State of one instrument, estimated from measurements of several kinds, and the next move of its actuators."""
