"""Elements on bodies, the exact trace through them, its derivatives, chief rays."""
