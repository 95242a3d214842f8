"""Comparison of run folders of one kind, and verification of a run folder: inputs, results and images."""
