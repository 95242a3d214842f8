"""Image matching: templates and an image in, sub-pixel places with covariances and verdicts out.

`distinct_points` chooses where to measure, `resampled` brings a patch of another image into the image's geometry,
`match` searches by normalised cross-correlation (`correlation`) and refines by least squares matching
(`least_squares`), `consensus` rejects what the neighbours contradict. Places are (row, column), the centre of the
first pixel is (0, 0). Stands on numpy, scipy and OpenCV alone and never sees the truth of a simulation.
"""
