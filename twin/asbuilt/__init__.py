"""As-built state of an instrument, estimated from all measurements on it, and the next alignment move.

The state is the position, shape and temperature of the bodies relative to the drawing. An alignment move is a motion of
actuators.
"""
