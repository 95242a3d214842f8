"""The job of `python -m twin.render`, the main job: perturb an instrument and estimate the changes from images.

The package holds its run, files and report.
"""
