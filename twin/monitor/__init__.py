"""Monitoring experiment: perturbed states, their true changes, spot images, and recovery of the changes."""
