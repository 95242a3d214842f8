"""Tolerances of a camera with compensators: sensitivities, limits, yield, and allocation of limits."""
