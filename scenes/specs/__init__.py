"""What each kind of file may say, checked and in SI units."""
