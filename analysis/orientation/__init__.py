"""Interior orientation and distortion from angles and spot positions (paper 004)."""
