"""Perturb, render, detect: the commands of the twin and their reports."""
