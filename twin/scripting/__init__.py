"""Implementation of the names that ``import twin`` offers to Python scripts."""
