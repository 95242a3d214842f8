"""Command ``python -m twin.doctor [--quick] [--json]``: checks that this machine can run the twin.

It reports Python, cores, LLVM, Dr.Jit, Mitsuba, GPU and the versions of the dependencies. A small float64 kernel and a
small render run in child processes, so that an unsuitable LLVM, which aborts its process, does not abort the doctor.
Exit code 0 if the twin can run, 1 if not.
"""

if __name__ == "__main__":
    from scenes.yaml.interrupt import end_quietly

    end_quietly()

import importlib.metadata
import json
import os
import platform
import signal
import subprocess
import sys
import tomllib
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from packaging.requirements import Requirement
from rich.console import Console
from rich.table import Table
from rich.text import Text

from scenes.yaml.standard_output import Terminal, print_json, to_stdout

DISTRIBUTION = "space-camera-twin"
OLDEST_PYTHON = (3, 11)
PROBE_TIMEOUT_S = 120.0
"""Time limit of a probe, in seconds: it normally takes about one, so that this is reached only if something hangs."""

Status = Literal["ok", "note", "failed"]


@dataclass(frozen=True)
class Check:
    """One line of the doctor's report: name of the check, status and detail.

    The status is "ok", "note" for information, or "failed", which makes the exit code 1.
    """

    name: str
    status: Status
    detail: str


def run_probe(arguments: list[str], timeout_s: float = PROBE_TIMEOUT_S) -> dict[str, Any]:
    """Run Python with these arguments in a child process and return the JSON object on its last line of stdout.

    Parameters
    ----------
    arguments : list[str]
        Arguments of the interpreter, for instance ["-m", "twin.framework.doctor_probe", "kernel"].
    timeout_s : float
        Time in seconds after which the child is killed.

    Raises
    ------
    RuntimeError
        The child crashed, hung, failed, or returned no JSON; the message can be shown to users.
    """
    root = str(Path(__file__).resolve().parent.parent)
    environment = dict(os.environ)
    environment["PYTHONPATH"] = os.pathsep.join(part for part in (root, environment.get("PYTHONPATH", "")) if part)
    try:
        child = subprocess.run(
            [sys.executable, *arguments],
            capture_output=True,
            text=True,
            timeout=timeout_s,
            env=environment,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise RuntimeError(f"no answer after {timeout_s:g} s") from error
    if child.returncode < 0:
        number = -child.returncode
        name = signal.Signals(number).name if number in set(signal.Signals) else str(number)
        hint = "; Dr.Jit needs LLVM 17 or newer" if "Cannot select" in child.stderr else ""
        raise RuntimeError(f"the process crashed with {name}{hint}{_last_words(child.stderr)}")
    try:
        answer = json.loads(child.stdout.strip().splitlines()[-1])
    except (IndexError, json.JSONDecodeError) as error:
        raise RuntimeError(f"exit code {child.returncode} without a result{_last_words(child.stderr)}") from error
    if "error" in answer:
        raise RuntimeError(str(answer["error"]))
    result: dict[str, Any] = answer["result"]
    return result


def examine(quick: bool = False) -> list[Check]:
    """Return all checks, in the order of the report.

    Parameters
    ----------
    quick : bool
        Omit checks of optional parts: the GPU and the second Mitsuba variant.
    """
    checks = [_python(), _system(), _libatomic(), _llvm()]
    checks.append(
        _probe(
            "kernel",
            ["kernel"],
            lambda r: f"float64 on LLVM {r['version']}, Dr.Jit {r['drjit']}, error {r['error']:.1e}",
        )
    )
    for variant in ("llvm_ad_mono",) if quick else ("llvm_ad_mono", "llvm_ad_rgb"):
        checks.append(
            _probe(f"render {variant}", ["render", variant], lambda r: f"Mitsuba {r['mitsuba']}, {r['variant']}")
        )
    if not quick:
        checks.append(_gpu())
    return [*checks, *_versions(), *_extensions()]


def _python() -> Check:
    """Check the version of Python."""
    good = sys.version_info >= OLDEST_PYTHON
    needed = "" if good else f"; needs {'.'.join(map(str, OLDEST_PYTHON))} or newer"
    return Check("Python", "ok" if good else "failed", f"{platform.python_version()} at {sys.executable}{needed}")


def _system() -> Check:
    """Report platform and cores."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return Check("system", "ok", f"{platform.platform()}, {usable} of {os.cpu_count()} cores usable")


def _libatomic() -> Check:
    """Check that libatomic loads."""
    try:
        from optics.numerics.llvm import check_libatomic

        check_libatomic()
    except ImportError as error:
        return Check("libatomic", "failed", str(error))
    return Check("libatomic", "ok", "loads" if sys.platform == "linux" else "not needed here")


def _llvm() -> Check:
    """Find the LLVM library that Dr.Jit uses."""
    chosen = "named by DRJIT_LIBLLVM_PATH" if os.environ.get("DRJIT_LIBLLVM_PATH") else "from karellen-llvm-core"
    try:
        from optics.numerics.llvm import ensure_llvm, find_llvm

        library = ensure_llvm()
    except ImportError as error:
        return Check("LLVM", "failed", str(error))
    if library is None:
        return Check("LLVM", "note", "searched by Dr.Jit itself")
    # Importing optics sets the variable, so that its present value may come from either.
    chosen = "from karellen-llvm-core" if library == find_llvm() else chosen
    return Check("LLVM", "ok", f"{library} ({chosen})")


def _probe(name: str, arguments: list[str], describe: Any) -> Check:
    """Run a probe of ``twin.framework.doctor_probe`` and describe its result."""
    try:
        return Check(name, "ok", describe(run_probe(["-m", f"{__package__}.framework.doctor_probe", *arguments])))
    except RuntimeError as error:
        return Check(name, "failed", str(error))


def _gpu() -> Check:
    """Check that Dr.Jit can use a GPU."""
    try:
        result = run_probe(["-m", f"{__package__}.framework.doctor_probe", "gpu"])
    except RuntimeError as error:
        return Check("GPU", "note", f"--backend cuda does not work: {error}")
    if not result["available"]:
        return Check("GPU", "note", "no GPU that Dr.Jit can use; --backend cuda is not available")
    return Check(
        "GPU", "ok", f"{_gpu_name()}, CUDA {result['version']}, compute capability {result['compute_capability']}"
    )


def _gpu_name() -> str:
    """Return the names of the GPUs by nvidia-smi."""
    command = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=20.0, check=True)
    except (OSError, subprocess.SubprocessError):
        return "NVIDIA GPU"
    return ", ".join(answer.stdout.split("\n")).strip(", ") or "NVIDIA GPU"


def requirements() -> list[Requirement]:
    """Return the dependencies that apply to this Python and platform, with the versions that pyproject.toml allows.

    They are read from the installed distribution, or from pyproject.toml when the twin runs from a folder without being
    installed.
    """
    try:
        lines = importlib.metadata.requires(DISTRIBUTION) or []
    except importlib.metadata.PackageNotFoundError:
        project = Path(__file__).resolve().parent.parent / "pyproject.toml"
        lines = tomllib.loads(project.read_text("utf-8"))["project"]["dependencies"] if project.exists() else []
    parsed = map(Requirement, lines)
    return [spec for spec in parsed if spec.marker is None or spec.marker.evaluate({"extra": ""})]


def _versions() -> list[Check]:
    """Check the installed version of each dependency."""
    checks = []
    for spec in requirements():
        try:
            version = importlib.metadata.version(spec.name)
        except importlib.metadata.PackageNotFoundError:
            checks.append(Check(spec.name, "failed", f"not installed; pip install '{spec.name}{spec.specifier}'"))
            continue
        good = spec.specifier.contains(version, prereleases=True)
        checks.append(
            Check(spec.name, *(("ok", version) if good else ("note", f"{version}, required {spec.specifier}")))
        )
    return checks


def _extensions() -> list[Check]:
    """Name the entries that other installed distributions add to tables; no check without any.

    An entry of a group that no table has is never read, so that a misspelt group would go unnoticed.
    """
    from optics.numerics.extension_table import GROUPS, PREFIX, entries
    from scenes.yaml.errors import nearest

    checks = []
    for entry in entries():
        group = entry.group.removeprefix(PREFIX)
        if group in GROUPS:
            checks.append(Check("extension", "ok", str(entry)))
        else:
            near = nearest(group, GROUPS)
            hint = f"did you mean {PREFIX}{near}?" if near else f"allowed: {', '.join(GROUPS)}"
            checks.append(Check("extension", "note", f"{entry} is not used, no such group of entry points; {hint}"))
    return checks


def _show(checks: list[Check], good: bool, console: Console) -> None:
    """Print the checks as a table."""
    styles = {"ok": "green", "note": "yellow", "failed": "bold red"}
    table = Table(title="space camera twin: doctor", title_justify="left")
    table.add_column("check")
    table.add_column("status")
    table.add_column("detail", overflow="fold")
    for check in checks:
        table.add_row(check.name, Text(check.status, style=styles[check.status]), Text(check.detail))
    console.print(table)
    console.print("ready" if good else "not ready: see the lines marked failed")


def main(
    quick: Annotated[bool, typer.Option("--quick", help="Skip the GPU and the second Mitsuba variant.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Write JSON instead of a table.")] = False,
) -> None:
    """Check Python, LLVM, Dr.Jit, Mitsuba, GPU and the versions of the dependencies.

    Exit code 0 if the twin can run, 1 if not.

    Example: python -m twin.doctor --quick
    """
    checks = examine(quick)
    good = all(check.status != "failed" for check in checks)
    with to_stdout(Console(stderr=True)):
        if as_json:
            print_json({"ok": good, "checks": [asdict(check) for check in checks]}, indent=2)
        else:
            _show(checks, good, Terminal())
    raise typer.Exit(0 if good else 1)


def _last_words(stderr: str) -> str:
    """Return the error line of a child process: LLVM's if there is one, else the last line."""
    lines = [line.strip() for line in stderr.splitlines() if line.strip()]
    fatal = [line for line in lines if "LLVM ERROR" in line] or lines[-1:]
    return f": {fatal[0][:300]}" if fatal else ""


if __name__ == "__main__":
    typer.run(main)
