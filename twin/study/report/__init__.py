"""Statistics of a study's responses, and the study's report."""
