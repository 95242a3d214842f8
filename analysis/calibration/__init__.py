"""In-orbit geometric calibration of three-line cameras on fields of points (paper 003: Mo, Wang and Ming, 2015).

`adjustment` calibrates cameras (`analysis.orbit.three_line_model`) and says what residuals show of terms that are left
out, `strip_adjustment` takes the noise that image points share out of a pass by tie points, and has the
stepwise calibration. Laws of the readings' errors, robust weights and variance components are those of
`analysis.block`.
"""
