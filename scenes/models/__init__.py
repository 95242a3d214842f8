"""Optical models of specifications: bodies, elements, solids, thermal and disturbance models."""
