"""The twin as a library: what ``import twin`` offers."""
