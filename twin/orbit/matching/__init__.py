"""Points measured in a user's line images: the command `twin.orbit match`."""
