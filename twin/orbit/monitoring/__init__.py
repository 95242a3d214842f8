"""A monitored stereo pair in orbit: flight, readings, heights, the loop with mechanisms, numbers, report."""
