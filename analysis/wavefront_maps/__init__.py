"""Files of measured wavefronts as maps and Zernike coefficients, how they are oriented, and fits over any pupil."""
