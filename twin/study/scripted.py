"""Studies from a script: the perturbation of an instrument with ranges instead of numbers."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import takewhile
from pathlib import Path
from typing import Any, Protocol, cast

import xarray as xr

from analysis.monitor import parameters
from scenes.specs.perturbation import find_node, motion_of, put
from scenes.specs.resolved import ResolvedJob
from scenes.specs.study import NOISE, TOTAL, StudySpec
from scenes.yaml.errors import InputError, Issue, KeyPath, Problem, shown
from scenes.yaml.spec import validate
from scenes.yaml.yaml_file import YamlFile, dump_yaml
from twin.study.runs.base_job import Tree

ProgressCallback = Callable[[int, int], None]
"""Callback that receives the numbers of finished and of all runs."""

_NUMBER = r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
_RANGE = re.compile(rf"\(\s*({_NUMBER})\s*(\.\.|±|\+-)\s*({_NUMBER})\s*\)")
_FORMS = "'(-5 .. 5) um' for an even spread, '(0 +- 2) um' for a normal one, also in a row: '0 0 (-5 .. 5) um'"


class Perturbed(Protocol):
    """Interface of an instrument that can be perturbed, such as `twin.load` returns."""

    @property
    def resolved(self) -> ResolvedJob:
        """Job that describes the instrument, with its perturbation and settings."""

    def with_perturbations(self, perturb: Mapping[str, Mapping[str, Any]]) -> Perturbed:
        """Return the instrument with the perturbations of these bodies replaced.

        Raises InputError if that is impossible.
        """


@dataclass(frozen=True)
class Spread:
    """Number of a perturbation for which a range is given instead, so that it varies in a study.

    Attributes
    ----------
    key : KeyPath
        Key path of the number below ``perturb`` of the job.
    factor : dict
        Distribution of the number, in the form of a study's file.
    """

    key: KeyPath
    factor: Mapping[str, Any]

    @property
    def name(self) -> str:
        """Name of the factor, such as ``forward_M2_shift_z``."""
        node, *rest = (str(part) for part in self.key)
        parts = [node.removeprefix("base/").replace("/", "_"), *rest]
        if self.key[1] in ("shift", "rotate") or parts[-2:-1] == ["gradient"]:
            parts[-1] = "xyz"[int(parts[-1])]
        return "_".join(part for part in parts if part != "change")[:60]


def study(
    instrument: Perturbed | str | Path,
    vary: Mapping[str, Mapping[str, Any] | str],
    n: int = 100,
    *,
    seed: int = 0,
    design: str = "latin_hypercube",
    responses: Mapping[str, Mapping[str, Any]] | None = None,
    workers: int | None = None,
    out: str | Path | None = None,
    quiet: bool = False,
    progress: bool | ProgressCallback = True,
) -> xr.Dataset:
    """Perturb, render and recover an instrument many times, on all cores.

    Parameters
    ----------
    instrument : Perturbed or str or Path
        Instrument at the start, from `twin.load`; its other perturbations stay. Or a name or path that `twin.load`
        takes.
    vary : dict
        Motion as text -> range, ``{"M2 shift z": "(-5 .. 5) um"}``: a uniform distribution from -5 to 5; ``(0 +- 2)``
        is a normal one with sigma 2. Or body -> keys of a perturbation with ranges, ``{"M2": {"shift": "0 0 (-5 .. 5)
        um"}}``.
    n : int
        Number of runs.
    seed : int
        Seed of the design; the noise of each run has an independent random stream.
    design : str
        ``latin_hypercube``, ``sobol`` or ``monte_carlo``.
    responses : dict, optional
        Name -> ``{"key": [...], "sigma": [...], "noise": [...]}`` as in a study's file. By default the estimates of the
        estimator `model` and the true values of every camera's parameters and of the angle between two cameras.
    workers : int, optional
        Number of processes; one for each core by default.
    out : str or Path, optional
        Folder in which the study with its report is stored; none by default.
    quiet : bool
        True to show neither progress nor warnings.
    progress : bool or callable
        True to show a progress bar on a terminal and in a notebook; or a function ``progress(done, runs)`` that is
        called whenever runs have finished.

    Returns
    -------
    Dataset
        Value of every factor and response for each ``run``; runs whose light is lost are ``failed``, with a
        ``message``.

    Raises
    ------
    InputError
        Nothing varies, a range has a different form, or a value is not allowed in a job's file.
    RuntimeError
        The study could not be completed; the message gives the reason.
    """
    config = config_text(_loaded(instrument), vary, n, seed, design, responses)
    with tempfile.TemporaryDirectory(prefix="twin-study-") as folder:
        file, target = Path(folder) / "config.yaml", Path(folder) / "study" if out is None else Path(out)
        file.write_text(config, "utf-8")
        # a separate process, since workers started from here would each run the caller's script again
        command = [sys.executable, "-m", str(__package__), str(file), "--out", str(target), "--yes", "--json"]
        command += [] if workers is None else ["--workers", str(workers)]
        code, message = _run(command, quiet, progress)
        if code:
            why = f": {message.strip()}" if quiet else "; see above"
            raise RuntimeError(f"the study ended with exit code {code}{why}")
        with xr.open_dataset(target / "study.nc", engine="h5netcdf") as data:
            return data.load()


def _loaded(instrument: Any) -> Perturbed:
    """Return the instrument to be varied, read where a name or path names it; raise `InputError` for other objects."""
    if isinstance(instrument, str | Path):
        # imported late, since a command's study needs no twin
        from twin.scripting.instrument_twin import load

        return load(instrument)
    if not hasattr(instrument, "with_perturbations"):
        raise InputError(
            Issue(
                f"{type(instrument).__name__} is not an instrument that a study can vary",
                key=("instrument",),
                allowed="twin.load(NAME or FILE), which reads camera files as well, or the name or file itself",
            )
        )
    return cast(Perturbed, instrument)


def _run(command: list[str], quiet: bool, progress: bool | ProgressCallback) -> tuple[int, str]:
    """Run a study's command to its end; return its exit code and, if ``quiet``, the messages that it printed."""
    callback = progress if callable(progress) else _progress_bar() if progress and not quiet else _silent
    reading, writing = os.pipe()
    with os.fdopen(reading) as lines, tempfile.TemporaryFile("w+") as messages:
        words = [*command, "--progress-fd", str(writing)]
        try:
            done = subprocess.Popen(
                words, stdout=subprocess.DEVNULL, stderr=messages if quiet else None, pass_fds=(writing,)
            )
        finally:
            os.close(writing)
        try:
            for line in lines:  # until the other end is closed
                there, runs = line.split()
                callback(int(there), int(runs))
            code = done.wait()
        except BaseException:
            # the callback may raise an exception to stop the study, as Ctrl-C does
            done.send_signal(signal.SIGINT)
            done.wait()
            raise
        messages.seek(0)
        return code, messages.read()


def _silent(done: int, runs: int) -> None:
    """Ignore the progress of a study; used without a progress bar."""


def _progress_bar() -> ProgressCallback:
    """Return a callback that draws a progress bar on stderr, on a terminal or in a notebook; elsewhere a silent one.

    The command has its own progress display; this one needs only what is available in a script.
    """
    stream = sys.stderr
    if not (stream.isatty() or "ipykernel" in sys.modules):
        return _silent
    begun = time.monotonic()

    def show(done: int, total: int) -> None:
        full = _WIDTH * done // max(total, 1)
        spent = time.monotonic() - begun
        remaining = f", about {spent * (total - done) / done:.0f} s left" if 0 < done < total else ""
        bar = f"runs {'#' * full}{'.' * (_WIDTH - full)} {done} of {total}, {spent:.0f} s{remaining}"
        # padded, since the previous line may have been longer
        stream.write(f"\r{bar:<79}" + ("\n" if done == total else ""))
        stream.flush()

    return show


_WIDTH = 30
"""Length of the progress bar, characters."""


def pipe_progress(descriptor: int) -> ProgressCallback:
    """Return a callback that writes the progress into a pipe, one line each time; a closed reader is ignored.

    Parameters
    ----------
    descriptor : int
        File descriptor of the inherited pipe; child processes do not inherit it.
    """
    os.set_inheritable(descriptor, False)

    def write(done: int, total: int) -> None:
        with suppress(OSError):
            os.write(descriptor, f"{done} {total}\n".encode())

    return write


def config_text(
    instrument: Perturbed,
    vary: Mapping[str, Mapping[str, Any] | str],
    n: int,
    seed: int,
    design: str,
    responses: Mapping[str, Mapping[str, Any]] | None = None,
) -> str:
    """Return the text of the config.yaml of a scripted study; it takes the arguments of `study`."""
    spreads: list[Spread] = []
    middle: dict[str, Any] = {}
    for node, keys in _by_node(vary).items():
        middle[node] = {key: _with_middle_values(value, (node, key), spreads) for key, value in keys.items()}
    if not spreads:
        raise InputError(Issue("nothing varies", key=("vary",), allowed=_FORMS))
    resolved = instrument.with_perturbations(middle).resolved
    paths = {node: find_node(node, resolved.job.perturb) for node in middle}
    spreads = [Spread((paths[str(s.key[0])], *s.key[1:]), s.factor) for s in spreads]
    named = {"factors": {s.name: {"key": ["job", "perturb", *s.key], **s.factor} for s in spreads}}
    about = {
        "name": resolved.instrument.name,
        "base": {"command": "render", "file": "config.yaml"},
        **named,
        "design": {"kind": design, "runs": n, "seed": seed},
        "responses": _responses(resolved) if responses is None else {k: dict(v) for k, v in responses.items()},
    }
    spec = validate(StudySpec, YamlFile("", about, {}))
    return dump_yaml({"study": spec.plain(), "base": resolved.plain()})


def _by_node(vary: Mapping[str, Mapping[str, Any] | str]) -> dict[str, dict[str, Any]]:
    """Return body -> its perturbation by key; motions given as text ("M2 shift z") are expanded."""
    out: dict[str, dict[str, Any]] = {}
    for name, motion in vary.items():
        if isinstance(motion, Mapping):
            out.setdefault(name, {}).update(motion)
            continue
        if not isinstance(motion, str):
            raise _wrong("not a perturbation", (name,), shown(motion))
        try:
            node, kind, axis, quantity, pivot = motion_of(name)
        except Problem as problem:
            if " " not in name.strip():
                raise _wrong("not a perturbation", (name,), shown(motion)) from None
            raise InputError(problem.at("", key=("vary", name))) from None
        if quantity or (match := _RANGE.search(motion)) is None:
            raise _wrong("not a range", (name,), shown(quantity or motion))
        nothing = f"0 {motion[match.end() :].strip()}"
        put(out.setdefault(node, {}), kind, axis, motion, nothing)
        if pivot:
            out[node]["pivot"] = pivot
    return out


QUALITY = {
    "wfe": ("wfe_rms_waves",),
    "wfe_worst": ("wfe_worst_waves",),
    "defocus": ("defocus_um", "centre"),
    "mtf_line": ("mtf_along_line", "centre"),
    "mtf_track": ("mtf_along_track", "centre"),
}
"""Name of an image quality response of a camera without a monitor -> its key in quality.json."""


def _responses(resolved: ResolvedJob) -> Tree:
    """Return the default responses: estimated changes of every camera with their sigmas, and true changes.

    The estimates are those of the estimator by which a run is judged. Without a monitor the responses are true values
    and image quality.
    """
    out: Tree = {}
    if resolved.instrument.monitor is None:
        for camera in resolved.instrument.cameras:
            for parameter in parameters.ESTIMATED:
                out[f"{camera}_{parameter.key.rpartition('_')[0]}"] = {
                    "key": ["truth", "cameras", camera, parameter.key]
                }
            out |= {f"{camera}_{name}": {"key": ["quality", "cameras", camera, *key]} for name, key in QUALITY.items()}
        if len(resolved.instrument.cameras) == 2:
            out["angle_change"] = {"key": ["truth", "intersection_angle", "change_arcsec"]}
        return out
    estimator = "model" if resolved.disturbances is None else "posterior"
    for camera in resolved.instrument.cameras:
        for key in (parameter.key for parameter in parameters.CAMERA_PARAMETERS.values()):
            short = key.rpartition("_")[0]
            read = ["recovered", "cameras", camera, estimator, key]
            out[f"{camera}_{short}"] = _with_sigmas(read)
            out[f"{camera}_{short}_true"] = {"key": ["truth", "cameras", camera, key]}
    if len(resolved.instrument.cameras) == 2:
        out["angle_change"] = _with_sigmas(["recovered", "intersection_angle", estimator, "change_arcsec"])
        out["angle_change_true"] = {"key": ["truth", "intersection_angle", "change_arcsec"]}
    return out


def _with_sigmas(read: Sequence[str]) -> Tree:
    """Return the response for one estimated change, with the keys of its total sigma and its noise sigma.

    ``read`` is the key path of the change in the results.
    """
    *path, key = read
    return {"key": [*read], **{name: [*path, f"{key}{end}"] for name, end in (("sigma", TOTAL), ("noise", NOISE))}}


def _with_middle_values(value: Any, key: KeyPath, spreads: list[Spread]) -> Any:
    """Return ``value`` with each range in it replaced by the range's middle; the ranges are appended to ``spreads``."""
    if isinstance(value, Mapping):
        return {name: _with_middle_values(part, (*key, name), spreads) for name, part in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_with_middle_values(part, (*key, k), spreads) for k, part in enumerate(value)]
    if not isinstance(value, str) or "(" not in value:
        return value
    path = (*key, "change") if key[-1] == "temperature" else key
    ranges = {f"@{k}": match for k, match in enumerate(_RANGE.finditer(value))}
    names = iter(ranges)
    words = _RANGE.sub(lambda match: f" {next(names)} ", value).split()
    numbers = list(takewhile(lambda word: word in ranges or re.fullmatch(_NUMBER, word), words))
    unit = " ".join(words[len(numbers) :])
    if not unit or "(" in unit or not set(ranges) <= set(numbers):
        raise _wrong("not a range", key, shown(value))
    row = len(numbers) > 1
    for k, word in enumerate(numbers):
        if word in ranges:
            spreads.append(Spread((*path, k) if row else path, _factor(ranges[word], unit)))
    middle = [f"{_middle(ranges[word])}" if word in ranges else word for word in numbers]
    return [f"{number} {unit}" for number in middle] if row else f"{middle[0]} {unit}"


def _middle(match: re.Match[str]) -> float:
    first, second = float(match[1]), float(match[3])
    return 0.5 * (first + second) if match[2] == ".." else first


def _factor(match: re.Match[str], unit: str) -> Mapping[str, Any]:
    first, second = f"{match[1]} {unit}", f"{match[3]} {unit}"
    if match[2] == "..":
        return {"uniform": [first, second]}
    return {"normal": {"mean": first, "sigma": second}}


def _wrong(problem: str, key: KeyPath, value: str) -> InputError:
    return InputError(Issue(problem, key=("vary", *key), value=value, allowed=_FORMS))
