"""Tables of files that are refused, and what reads them."""
