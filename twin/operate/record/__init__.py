"""The record itself: what it holds, its database, how readings get into it, and its tables for other programs."""
