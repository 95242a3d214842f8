"""Focal-plane alignment: best focus from curves through focus, the plane through it, shims (paper 004)."""
