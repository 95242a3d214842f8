"""Interior orientation of line cameras: principal distance, principal point and distortion."""
