"""Estimators of in-orbit geometric calibration: ground points and orbit in, angles of the cameras and sigmas out.

Stands on numpy and scipy alone and never sees the truth of a simulation. `planes` is the method of
paper 000 (Liu and Huang, Infrared and Laser Engineering 43(10), 2014), `resection` is the photogrammetric method that
the paper compares with, `sensitivity` its error analysis. Of paper 003 (Mo, Wang and Ming, 2015) are the model of a
three-line camera (`three_line_model`), `calibration_parameters`, which also names what points leave open,
and `forward_intersection` for check points and for the quality of orbit and attitude data.
"""
