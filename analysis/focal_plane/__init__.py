"""Focal-plane alignment: best focus from through-focus curves, the plane through it, and shims (paper 004)."""
