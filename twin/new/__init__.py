"""Commented input files for a camera: `python -m twin.new` fills the templates beside this module."""
