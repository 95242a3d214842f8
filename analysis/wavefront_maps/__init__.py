"""Files of measured wavefronts as maps and Zernike coefficients, their orientation, and fits over any pupil."""
