"""What every command shares: options, run folder, pages, files, versions."""
