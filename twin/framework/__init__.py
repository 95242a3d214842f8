"""What every command shares: its options and progress, its run folder, results, reports, pages, figures and files."""
