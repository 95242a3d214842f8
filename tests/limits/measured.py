"""``python -m tests.limits.measured COMMAND ARGUMENTS``: a command in a process of its own, and what it took.

The last line of stdout is JSON: exit code, seconds of the processor (also those of processes that it started and
waited for, by themselves) and of the clock, bytes at most above those of the imported program, bytes that a monitor's
job was estimated to take, bytes and seconds of one core that the command was said to take before it started (0 where
nothing was), by the mean of the machine's paces before and after it, and these paces.
"""

from __future__ import annotations

import importlib
import json
import resource
import sys
import time
from pathlib import Path
from statistics import mean
from typing import Any

BEFORE = {"twin.render": "twin.main_job.render_command", "twin.study": "twin.study.study_command"}
"""Command -> what it imports in any case, which is no memory of a job."""


def resident(what: str) -> int:
    """Memory of this process, bytes: now (``VmRSS``) or at most so far (``VmHWM``)."""
    line = next(line for line in Path("/proc/self/status").read_text("ascii").splitlines() if line.startswith(what))
    return 1024 * int(line.split()[1])


def taken(command: str, arguments: list[str]) -> dict[str, Any]:
    """What the command takes."""
    from twin.monitor.monitor_memory import MonitorSize
    from twin.run import cost

    app = importlib.import_module(command if command != "twin.study" else "twin.study.__main__").app
    if command in BEFORE:
        importlib.import_module(BEFORE[command])
    estimates, counted = [0.0], MonitorSize.bytes

    def remembered(size: MonitorSize, detector: Any) -> float:
        estimates.append(counted(size, detector))
        return estimates[-1]

    MonitorSize.bytes = remembered  # type: ignore[method-assign]
    said, required = [cost.Cost(0.0, 0.0)], cost.require_memory

    def checked(asked: cost.Cost) -> None:
        said.append(asked)
        required(asked)

    cost.require_memory = checked
    paces = [cost.pace()]
    start, clock, processor = resident("VmRSS"), time.monotonic(), time.process_time()
    code: Any = 0
    try:
        code = app(arguments, standalone_mode=False) or 0
    except SystemExit as end:
        code = end.code
    except Exception as error:
        code = getattr(error, "exit_code", 1)
        if not hasattr(error, "exit_code"):
            raise
    others = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = {"clock": time.monotonic() - clock, "processor": time.process_time() - processor}
    seconds["others"] = others.ru_utime + others.ru_stime
    used = resident("VmHWM") - start
    # a machine that others use as well changes its pace meanwhile
    paces.append(cost.pace())
    told = {"told_bytes": said[-1].bytes, "told_seconds": said[-1].seconds * mean(paces), "paces": paces}
    return {"code": code, **seconds, "used": used, "estimated": estimates[-1], **told}


if __name__ == "__main__":
    sys.stdout.write("\n" + json.dumps(taken(sys.argv[1], sys.argv[2:])) + "\n")
