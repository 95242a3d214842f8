"""YAML at the edge: files, units, errors with line and remedy."""
