"""Line cameras for other photogrammetric software: USGS CSM line scanners and rational polynomials."""
