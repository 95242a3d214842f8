"""Calibration in orbit over test fields (paper 003): campaign, image points, adjustment and report."""
