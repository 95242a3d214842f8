"""In-orbit geometric calibration of three-line cameras on test fields (paper 003: Mo, Wang and Ming, 2015).

`adjustment` calibrates cameras (`analysis.orbit.three_line_model`) and tests the residuals for terms omitted from the
model; `strip_adjustment` estimates the noise that image points of a pass share from tie points, and implements the
stepwise calibration. Error models of the readings, robust weights and variance components are those of
`analysis.block`.
"""
