"""Estimators of in-orbit geometric calibration: ground points and orbit in, angles of the cameras and sigmas out.

Stands on numpy and scipy alone and never sees the truth of a simulation. `planes` and `angles` are the method of
paper 000 (Liu and Huang, Infrared and Laser Engineering 43(10), 2014), `resection` is the photogrammetric method that
the paper compares with, `sensitivity` its error analysis. The rest is paper 003 (Mo, Wang and Ming, 2015): `adjustment`
and `stepwise` calibrate a three-line camera (`three_line_model`) on fields of points, `null_space` names what stays
open, `forward_intersection` gives check points, `third_difference` the quality of orbit and attitude data;
`shared_noise` is what image points have in common, and `strip_adjustment` takes it out of a pass by tie points.
"""
