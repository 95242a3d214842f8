"""Calibration over test fields: the campaign, image points drawn or measured, the procedure, report (paper 003)."""
