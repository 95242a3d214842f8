"""Monitoring experiment: perturb an instrument's state, render the monitor's spot images, and estimate the changes.

The monitor is an on-board source whose spots on area CCDs show changes of the cameras. The true changes are computed
for comparison.
"""
