"""Optimisation of prescriptions with exact derivatives."""
