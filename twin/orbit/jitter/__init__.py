"""Search for jitter of the attitude in points that the lines of a camera see one after the other."""
