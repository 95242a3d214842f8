"""Modulation transfer function (MTF) of a camera from images of slanted edges and of bars.

It is also the command ``python -m analysis.mtf``.
"""
