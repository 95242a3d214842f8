"""The state of one instrument, estimated from measurements of several kinds, and the next move that follows from it."""
