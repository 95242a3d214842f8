"""Optimisation of mirror prescriptions (shapes and positions) with exact derivatives."""
