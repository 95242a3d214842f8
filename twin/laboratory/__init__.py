"""Laboratory tests, simulated: focal-plane alignment, distortion, turntable (paper 004); two autocollimators (001)."""
