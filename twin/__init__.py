"""Digital twin of space mapping cameras and of their on-board monitor: perturb, render, detect, recover.

    import twin

    pair = twin.load("gf7_pair")
    bent = pair.perturbed({"base/forward/M2": {"shift": "0 0 3 um"}})
    shot = bent.render(frames=9, seed=1)
    pair.recover(shot.before, shot.after).compare(shot.truth)

Functions, each with its own help, such as help(twin.load):

    load(what)           an instrument: InstrumentTwin, with perturbed, render, recover, camera, refocused, jacobian
    load_camera(what)    a single camera, with wavefront, spot, mtf (each with plot), first_order, refocused, perturbed,
                         and prescription, the camera as an optics.Camera
    study(pair, vary)    runs an instrument many times with factors that vary: a table of all runs
    perform(name, file)  runs the procedure of a command on a file, such as "lab focus" or "tolerance": TestResult

Results:

    Shot                 of render: frames before and after, truth, verdict; save writes the run folder
    Recovered            of recover: readings with their sigmas; compare lists them with the truth
    TestResult           of perform: numbers, summary, report
    InputError           raised for an input that cannot be used: file, line, key, what is allowed

All of them have a short representation, and in a notebook a figure or table. The names below are imported on first use,
so that a command loads no library that it does not need.
"""

from __future__ import annotations

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

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scenes.yaml.errors import InputError
    from twin.scripting.instrument_twin import InstrumentTwin, load, load_camera
    from twin.scripting.results import Recovered, Shot, TestResult, perform
    from twin.study.scripted import study

__all__ = ["InputError", "InstrumentTwin", "Recovered", "Shot", "TestResult", "load", "load_camera", "perform", "study"]

_MODULES = {
    "load": "twin.scripting.instrument_twin",
    "load_camera": "twin.scripting.instrument_twin",
    "InstrumentTwin": "twin.scripting.instrument_twin",
    "Shot": "twin.scripting.results",
    "Recovered": "twin.scripting.results",
    "TestResult": "twin.scripting.results",
    "perform": "twin.scripting.results",
    "InputError": "scenes.yaml.errors",
}


def __getattr__(name: str) -> Any:
    if name == "study":
        # a package that can be called, see there
        return importlib.import_module(f"{__name__}.study")
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(__name__.removesuffix("twin") + _MODULES[name]), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
