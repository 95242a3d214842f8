"""Path tracing: light that reaches the detectors off the nominal path, and the energy balance of all light.

Mitsuba finds the surface that a ray hits; the intersection with it is then computed from the prescription in float64.
"""
