"""Points measured in a user's line images: what `twin.orbit match` does."""
