"""Library interface of the twin: implementation of the names that ``import twin`` offers."""
