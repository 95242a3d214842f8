"""From rays to images: wavefronts, pupils with their shadows, diffraction, transfer functions."""
