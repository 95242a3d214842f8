"""From specifications to bodies, elements and solids."""
