"""Checks of paper 003 (Mo et al. 2015): calibration of a three-line camera in orbit."""
