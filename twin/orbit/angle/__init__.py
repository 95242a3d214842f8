"""Intersection angles of lines (paper 000, Liu and Huang 2014) from planes through ground points, or resection."""
