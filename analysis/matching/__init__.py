"""Image matching: sub-pixel positions of templates in an image, with covariances and verdicts.

`distinct_points` selects points to measure, `resampled` brings a patch of another image into the image's geometry,
`match_windows` searches by normalised cross-correlation (`correlation`) and refines by least squares matching
(`least_squares`), and `consensus` rejects matches that contradict their neighbours. Positions are (row, column); the
centre of the first pixel is (0, 0). The package depends on numpy, scipy and OpenCV alone and never sees the truth of a
simulation.
"""
