"""A line camera in orbit: Earth, orbit, attitude, lines of sight and where they meet the ground."""
