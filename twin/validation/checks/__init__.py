"""What a check of a paper is, and how it is evaluated, and how printed numbers are read."""
