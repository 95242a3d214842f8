"""Line cameras in orbit: Earth, orbit, attitude, lines of sight and their intersections with the ground."""
