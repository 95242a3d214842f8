"""Run folders of one kind beside each other: what went in, what came out, and the images."""
