"""Estimate of an instrument's state from its record: filtered, smoothed and forecast, with its alarms."""
