"""Glasses, structural materials, and the reflection and scattering of surfaces."""
