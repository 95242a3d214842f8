"""What the on-board monitor buys on the ground: the flight, the procedure, JSON, report."""
