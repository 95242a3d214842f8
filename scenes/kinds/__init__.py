"""All kinds of YAML files."""
