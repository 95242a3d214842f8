"""Tolerances of a camera with compensators: sensitivities, limits, yield, allocation."""
