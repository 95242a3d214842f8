"""The live twin: a web page with sliders for every body, which shows spots and readings as they change."""
