"""Starts pytest in processes that have the large packages loaded already: most of what a short run of it takes.

`WarmPytest` starts this file as a program. It loads the packages, which no fault is put in, and forks for each run.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import threading
from importlib import import_module
from pathlib import Path

PACKAGES = (
    "cv2",
    "hypothesis",
    "matplotlib.pyplot",
    "numpy",
    "pint",
    "pydantic",
    "pytest",
    "ruamel.yaml",
    "scipy.interpolate",
    "scipy.ndimage",
    "scipy.optimize",
    "scipy.sparse.linalg",
    "scipy.spatial",
    "scipy.stats",
    "tifffile",
    "typer",
)
"""Loaded before the fork; none of them starts a thread, which would be lost in it. Not Dr.Jit, which has to be told its
LLVM first: that is code of the project, into which faults are put."""
_WAITING = 3600.0
"""Seconds after which a run that waits for ever, without computing, is given up."""


class WarmPytest:
    """Runs pytest as often as asked, one run after the other, each in a process of its own."""

    def __init__(self) -> None:
        environment = os.environ | {"OPENBLAS_NUM_THREADS": "1", "PYTHONHASHSEED": "0"}
        # The byte code beside the source is checked by its hash, that elsewhere only by time.
        for name in ("PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX"):
            environment.pop(name, None)
        self._server = subprocess.Popen(
            [sys.executable, "-P", __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def __enter__(self) -> WarmPytest:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.communicate()

    def run(
        self, tree: Path, arguments: list[str], told: Path, limit: int | None = None, more: dict[str, str] | None = None
    ) -> int:
        """Run pytest in a tree of the project.

        Args:
            tree: the folder, whose code and tests run.
            arguments: of pytest.
            told: file for what it writes to stdout and stderr.
            limit: processor time in seconds after which it is killed.
            more: variables of the environment.

        Returns:
            The exit code, or the negative number of the signal that ended it.
        """
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        job = {"tree": str(tree), "arguments": arguments, "told": str(told), "limit": limit, "more": more or {}}
        self._server.stdin.write(json.dumps(job) + "\n")
        self._server.stdin.flush()
        return int(self._server.stdout.readline())


def _serve() -> None:
    for name in PACKAGES:
        import_module(name)
    for line in sys.stdin:
        job = json.loads(line)
        child = os.fork()
        if not child:
            _become_pytest(job)
        late = threading.Timer(_WAITING, os.kill, (child, signal.SIGKILL))
        late.start()
        _, status = os.waitpid(child, 0)
        late.cancel()
        late.join()
        print(os.waitstatus_to_exitcode(status), flush=True)  # noqa: T201


def _become_pytest(job: dict) -> None:
    told = os.open(job["told"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for number, file in enumerate((nothing, told, told)):
        os.dup2(file, number)
    if job["limit"]:
        # From now on: what the server loaded does not count, as the clock starts at zero in a child.
        resource.setrlimit(resource.RLIMIT_CPU, (job["limit"], job["limit"] + 5))
    os.environ.update(job["more"])
    os.chdir(job["tree"])
    sys.path.insert(0, job["tree"])
    sys.argv = ["pytest", *job["arguments"]]
    import pytest

    code = int(pytest.main(job["arguments"]))
    sys.stdout.flush()
    sys.stderr.flush()
    # Without what C++ libraries do at an exit: they wait for threads, which the fork left behind.
    os._exit(code)


if __name__ == "__main__":
    _serve()
