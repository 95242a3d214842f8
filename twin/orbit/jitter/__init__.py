"""Search for attitude jitter in image points that the lines of a camera see one after the other."""
