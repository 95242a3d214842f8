"""Shared parts of all commands: options and progress, run folders, results, reports, pages, figures and files."""
