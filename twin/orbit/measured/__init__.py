"""What somebody measured of a pass: readings of the platform, line times, ground and image points; their files."""
