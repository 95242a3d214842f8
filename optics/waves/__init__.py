"""Physical optics: wavefronts, pupils with shadows, diffraction images and transfer functions."""
