"""Laboratory tests, simulated and measured: focal-plane alignment, distortion, turntable, autocollimators."""
