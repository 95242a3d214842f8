"""The live twin: a page on which a knob turns, the spots move and the readings follow."""
