"""Earth, orbit, attitude and line cameras on a satellite: from pixel to ground and back."""
