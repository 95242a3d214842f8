"""Intersection angles of lines from planes through the station and ground points, or from resection (paper 000)."""
