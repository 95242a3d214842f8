"""Reading of input files: YAML, tables, units, and error messages with file, line and remedy."""
