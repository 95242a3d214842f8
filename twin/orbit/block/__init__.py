"""Adjustment of a block of scenes from many passes, simulated or measured, and the contribution of each sensor."""
