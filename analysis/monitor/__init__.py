"""From spot shifts to a camera's parameters (paper 001)."""
