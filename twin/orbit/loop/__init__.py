"""The monitor in a loop with mechanisms along an orbit: what each does, the course, heights, numbers, report."""
