"""Is a run folder as its run left it, and does the run come out the same again."""
