"""Adjustment of a block of line images of one or many passes: what is observed, what is known of it, what results."""
