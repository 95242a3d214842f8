"""Images and measurements in, parameters and uncertainties out.

Stands alone on numpy, scipy and opencv and never sees the truth of a simulation, so that it can be used on real
images. Sub-modules: `noise`, `spot_template`, `centroid`, `monitoring`, `model_fit`, `intersection_angle`.
"""
