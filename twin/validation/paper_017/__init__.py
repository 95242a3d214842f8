"""Checks of Wang Renxiang (2017): bundles of line images without ground control."""
