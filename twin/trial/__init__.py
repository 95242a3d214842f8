"""What commands that run one test share: options, progress, result, report and run folder."""
