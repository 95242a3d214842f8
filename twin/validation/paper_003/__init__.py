"""Checks of paper 003: calibration of a three-line camera in orbit."""
