"""Earth, orbit, attitude, line cameras on a satellite: pixel to ground and back."""
