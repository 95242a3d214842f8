"""Adjustment of a block of line images from one or many passes: observations, priors and results."""
