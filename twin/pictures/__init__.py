"""Rendered pictures and the 3-D scene of an instrument."""
