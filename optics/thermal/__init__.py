"""Heat: temperature fields, thermo-elastic deformation of bodies."""
