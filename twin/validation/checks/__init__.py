"""What a check of a paper is, and how it is judged."""
