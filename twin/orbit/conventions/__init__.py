"""Check of the conventions of a pass's files against its ground points."""
