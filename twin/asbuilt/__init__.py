"""As-built state of an instrument, estimated from all measurements on it, and the next alignment move."""
