"""The live twin: a web page with sliders for every body that shows spots and estimated changes while they move."""
