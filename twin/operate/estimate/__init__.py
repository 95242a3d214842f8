"""The estimate from a record under a plan: followed, smoothed, forecast, and what of it somebody has to know."""
