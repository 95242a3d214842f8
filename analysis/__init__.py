"""Images and measurements in, parameters and uncertainties out.

Stands on numpy, scipy, opencv and `optics.numerics`, and never sees the truth of a simulation, so that it can be used
on real images. Sub-modules: `noise`, `spot_template`, `centroid`, `monitor_formulas`, `model_fit`.
"""

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
