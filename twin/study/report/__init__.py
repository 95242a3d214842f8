"""Statistics of a study and its report."""
