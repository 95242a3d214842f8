"""Block of scenes of many passes: drawn from stated laws, adjusted, and what each sensor is worth on the ground."""
