"""Checks of paper 001: on-board monitoring by optical autocollimation."""
