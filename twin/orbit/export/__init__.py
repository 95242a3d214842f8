"""Export of line cameras to other photogrammetric software: CSM line scanners (USGS) and rational polynomials."""
