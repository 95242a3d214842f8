"""Input files, and the optical assemblies and scenes made of them: cameras, instruments, detectors and jobs in YAML."""

import os
import sys

# "python -m" puts the folder where it is started before all others, so that a numpy.py or an optics.py there would be
# run. It is taken out, also for processes that this one starts, unless this package itself was found there. These
# lines stand in each package that has commands: whatever they would be imported from could be such a file, too.
if (
    sys.argv[:1] == ["-m"]
    and not sys.flags.safe_path
    and sys.orig_argv[-len(sys.argv)].removeprefix("-m").partition(".")[0] == __name__
    and sys.path[0] != os.path.dirname(os.path.dirname(os.path.abspath(__file__)))
):
    del sys.path[0]
    os.environ["PYTHONSAFEPATH"] = "1"
