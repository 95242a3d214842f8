"""Estimators for in-orbit geometric calibration: camera angles and their covariance from ground points and orbit data.

The package depends on numpy and scipy alone and never sees the truth of a simulation. `planes` implements the method of
paper 000 (Liu and Huang, Infrared and Laser Engineering 43(10), 2014) and its sensitivity analysis; `resection` is the
photogrammetric method that the paper compares it with. From paper 003 (Mo, Wang and Ming, 2015) come the model of a
three-line camera (`three_line_model`), the calibration parameters and their observability (`calibration_parameters`),
and `forward_intersection`, for check points and for the quality of orbit and attitude data.
"""
