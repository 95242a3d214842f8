"""Changes of a camera's parameters from the shifts of its monitor's spots (paper 001)."""
