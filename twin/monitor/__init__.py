"""The monitoring experiment: perturbed states, their truth, spot images, recovery."""
