"""The job of `python -m twin.render`: its run, files and report."""
