"""Laboratory tests of a camera, simulated: focal-plane alignment, distortion, turntable (paper 004)."""
