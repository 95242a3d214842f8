"""Where things are and what shape they have: rigid bodies, surfaces, apertures, solids, polygons."""
