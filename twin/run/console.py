"""The command ``twin``: ``twin render JOB`` is ``python -m twin.render JOB``, from whatever folder it is started.

Unlike ``python -m`` it never looks for modules where it is started, not even for one that is named ``twin.py``.
"""

from __future__ import annotations

import os
import runpy
import sys

PROGRAMS = {
    "render": "twin.render",
    "recover": "twin.recover",
    "lab": "twin.lab",
    "orbit": "twin.orbit",
    "study": "twin.study",
    "design": "twin.design",
    "mtf": "analysis.mtf",
    "lens": "scenes.lens",
    "schema": "scenes.schema",
    "camera": "twin.camera",
    "compare": "twin.compare",
    "doctor": "twin.doctor",
    "export": "twin.export",
    "live": "twin.live",
    "uncertainty": "twin.uncertainty",
    "validate": "twin.validate",
    "verify": "twin.verify",
}
"""First word -> the module that is run."""


def main() -> None:
    """Run the program that the first word names, with the words after it."""
    # for processes that are started from here
    os.environ["PYTHONSAFEPATH"] = "1"
    name, *words = sys.argv[1:] or [""]
    if name in ("", "-h", "--help"):
        listed = "\n".join(f"  twin {name:12} python -m {module}" for name, module in PROGRAMS.items())
        sys.stdout.write(f"Usage: twin PROGRAM ...\n\n{listed}\n\ntwin PROGRAM --help says more.\n")
        sys.exit(0 if name else 2)
    if name not in PROGRAMS:
        sys.stderr.write(f"unknown program {name!r}; choose {', '.join(PROGRAMS)}\n")
        sys.exit(2)
    sys.argv[1:] = words
    runpy.run_module(PROGRAMS[name], run_name="__main__", alter_sys=True)
