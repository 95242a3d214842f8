"""Glasses, structural materials, and what surfaces do with light."""
