"""A process that has the program and its tests loaded, and forks for each fault: a short run of tests takes a second.

The child puts the new code into the functions that a fault changes. A fault outside of functions, in a constant or a
default of an argument, makes it load the project's modules anew from the tree, which has the fault as well, for
commands that tests start as processes of their own.
"""

from __future__ import annotations

import functools
import gc
import importlib
import json
import os
import resource
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from types import CodeType, FunctionType

PACKAGES = ("optics", "scenes", "analysis", "twin")
"""Of the program; faults are put into them."""
_WAITING = 900.0
"""Seconds after which a run that waits for ever, without computing, is given up."""
_OPTIMISED = 1
"""Flag of a code object that belongs to a function."""


class ForkServer:
    """Runs pytest in one tree as often as asked, one run after the other, each in a process of its own.

    Parameters
    ----------
    tree : Path
        Copy of the project, whose code and tests run.
    """

    def __init__(self, tree: Path) -> None:
        self.tree = tree
        environment = os.environ | {
            "OPENBLAS_NUM_THREADS": "1",
            "NUMEXPR_MAX_THREADS": "1",
            "PYTHONHASHSEED": "0",
            "PYTHONPATH": str(tree),
        }
        # The byte code beside the source is checked by its hash, that elsewhere only by time.
        for name in ("PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX"):
            environment.pop(name, None)
        words = [sys.executable, "-P", str(Path(__file__).resolve())]
        self._server = subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=tree
        )

    def __enter__(self) -> ForkServer:
        return self

    def __exit__(self, *_: object) -> None:
        self._server.communicate()

    def run(self, arguments: list[str], told: Path, limit: int, changed: str = "") -> int:
        """Run pytest.

        Parameters
        ----------
        arguments : list of str
            Words of the command line.
        told : Path
            File for what it writes to stdout and stderr.
        limit : int
            Processor time in seconds after which it is killed.
        changed : str
            Source file below the tree that holds a fault now.

        Returns
        -------
        int
            The exit code, or the negative number of the signal that ended it.
        """
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        job = {"arguments": arguments, "told": str(told), "limit": limit, "changed": changed}
        self._server.stdin.write(json.dumps(job) + "\n")
        self._server.stdin.flush()
        return int(self._server.stdout.readline())


def functions_changed(old: CodeType, new: CodeType) -> Iterator[tuple[CodeType, CodeType] | None]:
    """Yield the outermost functions of a module that differ, old and new; None where a module or class itself does."""
    if old.co_flags & _OPTIMISED:
        if not _alike(old, new):
            yield old, new
        return
    if not _alike(old, new, deep=False):
        yield None
    inner = [[one for one in code.co_consts if isinstance(one, CodeType)] for code in (old, new)]
    for one, other in zip(*inner, strict=True):
        yield from functions_changed(one, other)


def _alike(old: CodeType, new: CodeType, deep: bool = True) -> bool:
    """Whether two code objects do the same; their lines may differ."""
    if (old.co_code, old.co_names, old.co_varnames) != (new.co_code, new.co_names, new.co_varnames):
        return False
    if len(old.co_consts) != len(new.co_consts):
        return False
    for one, other in zip(old.co_consts, new.co_consts, strict=True):
        if isinstance(one, CodeType) and isinstance(other, CodeType):
            if deep and not _alike(one, other):
                return False
        elif type(one) is not type(other) or repr(one) != repr(other):
            return False
    return True


def _put_in(source: str, tree: Path, before: bytes) -> bool:
    """Give the loaded functions of a module the code that its file now holds; False where that is not enough."""
    path = tree / source
    old, new = (compile(text, str(path), "exec", dont_inherit=True) for text in (before, path.read_bytes()))
    try:
        changed = list(functions_changed(old, new))
    except ValueError:
        return False
    if None in changed:
        return False
    codes = {(one[0].co_qualname, one[0].co_firstlineno): one[1] for one in changed if one}
    for one in gc.get_objects():
        if isinstance(one, functools._lru_cache_wrapper):
            # what was computed while the tests were loaded is computed again
            one.cache_clear()
        if isinstance(one, FunctionType) and one.__code__.co_filename == str(path):
            code = codes.get((one.__code__.co_qualname, one.__code__.co_firstlineno))
            if code is not None:
                if code.co_freevars != one.__code__.co_freevars:
                    return False
                one.__code__ = code
    return True


def _load(tree: Path) -> None:
    """Import the program and the tests; none of them starts Dr.Jit's threads, which would be lost in a fork."""
    for name in ("pytest", "hypothesis", "typer.testing", "matplotlib.pyplot", "scipy.stats", "cv2", "tifffile"):
        importlib.import_module(name)
    for file in sorted((tree / "tests").rglob("*.py")):
        name = ".".join(file.relative_to(tree).with_suffix("").parts)
        if file.stem.startswith("__") or name.split(".")[1] in ("mutation", "benchmarks"):
            continue
        try:
            importlib.import_module(name)
        except BaseException as error:
            sys.stderr.write(f"{name} is not loaded beforehand: {type(error).__name__}\n")


def _serve() -> None:
    tree = Path.cwd()
    sys.path.insert(0, str(tree))
    _load(tree)
    sources = {
        file.relative_to(tree).as_posix(): file.read_bytes()
        for package in PACKAGES
        for file in (tree / package).rglob("*.py")
    }
    for line in sys.stdin:
        job = json.loads(line)
        child = os.fork()
        if not child:
            _become_pytest(job, tree, sources)
        late = threading.Timer(_WAITING, os.kill, (child, signal.SIGKILL))
        late.start()
        _, status = os.waitpid(child, 0)
        late.cancel()
        late.join()
        print(os.waitstatus_to_exitcode(status), flush=True)  # noqa: T201


def _become_pytest(job: dict, tree: Path, sources: dict[str, bytes]) -> None:
    told = os.open(job["told"], os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    nothing = os.open(os.devnull, os.O_RDONLY)
    for number, file in enumerate((nothing, told, told)):
        os.dup2(file, number)
    os.setpgid(0, 0)
    # From now on: what the server loaded does not count, as the clock starts at zero in a child.
    resource.setrlimit(resource.RLIMIT_CPU, (job["limit"], job["limit"] + 5))
    changed = job["changed"]
    if changed and not _put_in(changed, tree, sources[changed]):
        for name in [name for name in sys.modules if name.split(".")[0] in (*PACKAGES, "tests")]:
            del sys.modules[name]
    sys.argv = ["pytest", *job["arguments"]]
    import pytest

    code = int(pytest.main(job["arguments"]))
    sys.stdout.flush()
    sys.stderr.flush()
    # Without what C++ libraries do at an exit: they wait for threads, which the fork left behind.
    os._exit(code)


if __name__ == "__main__":
    _serve()
