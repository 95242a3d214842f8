"""Contents of each kind of input file, checked and in SI units."""
