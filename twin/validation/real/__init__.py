"""Checks against measured data of other projects, which are not part of this one."""
