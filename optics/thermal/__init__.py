"""Temperature fields, and the thermo-elastic deformation of bodies."""
