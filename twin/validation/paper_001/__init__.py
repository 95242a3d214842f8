"""Checks of paper 001 (Wang et al. 2018): on-board monitoring by optical autocollimation."""
