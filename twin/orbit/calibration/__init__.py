"""Calibration in orbit over test fields (paper 003, Mo et al. 2015): campaign, image points, adjustment, report."""
