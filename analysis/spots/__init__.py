"""Centres of spots with their covariance."""
