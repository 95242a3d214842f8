"""Which conventions the numbers of a pass in files can have, tried on its ground points."""
