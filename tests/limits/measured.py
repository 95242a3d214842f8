"""``python -m tests.limits.measured COMMAND ARGUMENTS``: a command in a process of its own, and what it took.

The last line of stdout is JSON: exit code, seconds of the processor (also those of processes that it started and
waited for, by themselves) and of the clock, bytes at most above those of the imported program, and bytes that a
monitor's job was estimated to take (0 where nothing was).
"""

from __future__ import annotations

import importlib
import json
import resource
import sys
import time
from pathlib import Path
from typing import Any

BEFORE = {"twin.render": "twin.main_job.render_command", "twin.study": "twin.study.study_command"}
"""Command -> what it imports in any case, which is no memory of a job."""


def resident(what: str) -> int:
    """Memory of this process, bytes: now (``VmRSS``) or at most so far (``VmHWM``)."""
    line = next(line for line in Path("/proc/self/status").read_text("ascii").splitlines() if line.startswith(what))
    return 1024 * int(line.split()[1])


def taken(command: str, arguments: list[str]) -> dict[str, Any]:
    """What the command takes."""
    from twin.monitor.monitor_experiment import MonitorSize

    app = importlib.import_module(command if command != "twin.study" else "twin.study.__main__").app
    if command in BEFORE:
        importlib.import_module(BEFORE[command])
    estimates, counted = [0.0], MonitorSize.bytes

    def remembered(size: MonitorSize, detector: Any) -> float:
        estimates.append(counted(size, detector))
        return estimates[-1]

    MonitorSize.bytes = remembered  # type: ignore[method-assign]
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
    return {"code": code, **seconds, "used": used, "estimated": estimates[-1]}


if __name__ == "__main__":
    sys.stdout.write("\n" + json.dumps(taken(sys.argv[1], sys.argv[2:])) + "\n")
