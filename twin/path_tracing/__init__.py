"""Path tracing: what reaches the detectors by other ways than the nominal one, and where the rest of the light goes.

Mitsuba decides what a ray hits, the prescription decides where exactly: every hit is refined in float64.
"""
