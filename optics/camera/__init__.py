"""A camera from the numbers of its surfaces: its rays, wavefront, point spread function, MTF and distortion."""
