"""A process that runs one command after the other: a line of JSON in, a line of JSON out.

Each command finds its arguments, standard streams of its own and the project's folder as it would in a process that
was started for it; what the packages take to be imported is spent once.
"""

from __future__ import annotations

import gc
import json
import os
import runpy
import signal
import sys
import tempfile
import traceback
from typing import Any


def used() -> float:
    """Return the seconds of processor time of this process and of those that it has waited for."""
    times = os.times()
    return sum(times[:4])


def run(words: list[str]) -> dict[str, Any]:
    """Run a module with its arguments.

    Returns:
        ``code``, ``stdout``, ``stderr`` and ``seconds`` of processor time.
    """
    start = used()
    streams = [tempfile.TemporaryFile() for _ in (1, 2)]
    for place, stream in zip((1, 2), streams, strict=True):
        os.dup2(stream.fileno(), place)
    sys.stdout = open(1, "w", encoding="utf-8", closefd=False)
    sys.stderr = open(2, "w", encoding="utf-8", closefd=False, buffering=1)
    sys.argv = [*words]
    code: Any = 0
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        # runpy warns of a module that an earlier job has imported
        for name in (words[0], f"{words[0]}.__main__"):
            sys.modules.pop(name, None)
        runpy.run_module(words[0], run_name="__main__", alter_sys=True)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
    except BaseException:
        traceback.print_exc()
        code = 1
    for number, handler in handlers.items():
        signal.signal(number, handler)
    texts = []
    for stream, wrapper in zip(streams, (sys.stdout, sys.stderr), strict=True):
        try:
            wrapper.flush()
        except (OSError, ValueError):
            pass
        stream.seek(0)
        texts.append(stream.read().decode("utf-8", "replace"))
        stream.close()
    gc.collect()
    return {"code": code, "stdout": texts[0], "stderr": texts[1], "seconds": used() - start}


def main() -> None:
    """Answer on what was standard output until nothing more is asked."""
    answers = open(os.dup(1), "w", encoding="utf-8")
    for line in sys.stdin:
        answers.write(json.dumps(run(json.loads(line))) + "\n")
        answers.flush()


if __name__ == "__main__":
    main()
