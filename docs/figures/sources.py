"""Sources of measured figures, and the file that stores them."""

from __future__ import annotations

import csv
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

from ruamel.yaml import YAML

from docs.figures.studies import STUDIES, Read
from scenes.yaml.yaml_file import read_yaml

ROOT = Path(__file__).resolve().parents[2]
FILE = Path(__file__).with_name("figures.yaml")
SUMMARY = ROOT / "docs/validation/README.md"
"""Summary of a full run of twin.validate."""
HEAD = "# Measured figures that README and docs quote. Made by `python -m docs.figures`; not to be edited.\n"
_NUMBER = re.compile(r"(-?[\d.]+(?:e-?\d+)?)(?: ± ([\d.]+))?")


@dataclass(frozen=True)
class Figure:
    """Measured number.

    Attributes
    ----------
    value : float
        Value in the unit.
    sigma : float or None
        Standard deviation in the unit, None where it is unknown.
    unit : str
        Unit, empty for a dimensionless number.
    digits : int
        Decimals with which pages quote it by default.
    command : str
        Command that measures it.
    seed : int or None
        Seed of its random numbers, None where there are none.
    """

    value: float
    sigma: float | None
    unit: str
    digits: int
    command: str
    seed: int | None


def _checks() -> Iterator[tuple[str, int, float, str]]:
    """Return name, decimals, factor from the summary's unit, and unit of the papers' checks that pages quote."""
    with FILE.with_name("checks.csv").open(encoding="utf-8", newline="") as lines:
        for row in csv.DictReader(lines):
            yield row["check"], int(row["digits"]), float(row["factor"]), row["unit"]


def _at(file: str, *keys: str, per: float = 1.0) -> Read:
    """Return a reader of the number below these keys of a JSON file, times ``per``."""

    def read(run: Path) -> float:
        value = json.loads((run / file).read_text("utf-8"))
        for key in keys:
            value = value[key]
        return per * float(value)

    return read


def _share(quantity: tuple[str, ...], motion: str) -> Read:
    """Return a reader of the share of motions, by name prefix, in the variance of a `posterior` reading, in percent."""

    def read(run: Path) -> float:
        value = json.loads((run / "uncertainty.json").read_text("utf-8"))["quantities"]
        for key in quantity:
            value = value[key]
        lines = value["after"]["posterior"]["lines"]
        return 100.0 * sum(one["share"] for one in lines if one["motion"].startswith(motion))

    return read


def _false_turn(run: Path) -> float:
    """Return the rotation about Y, in arcseconds, that the forward camera's spots show although it did not occur."""
    read, true = (json.loads((run / f"{name}.json").read_text("utf-8"))["cameras"] for name in ("recovered", "truth"))
    return abs(float(read["forward"]["model"]["d_alpha_arcsec"] - true["forward"]["d_alpha_arcsec"]))


ANGLE = ("intersection_angle", "change_arcsec")
HEIGHT = ("ground", "height_m")
CHANGES = {"d_alpha": ("arcsec", 2), "d_beta": ("arcsec", 2), "d_gamma": ("arcsec", 2), "d_f": ("um", 1)}
GROUND = ("along", "across", "height")


def _readings() -> dict[str, tuple[int, str, Read]]:
    """Return figures of the example job: true values, `posterior` readings, and both sigmas.

    They are those of the backward camera, the angle between the cameras and a point on the ground.
    """
    out: dict[str, tuple[int, str, Read]] = {
        "launch.angle_true": (3, "arcsec", _at("truth.json", *ANGLE)),
        "launch.angle_read": (2, "arcsec", _at("recovered.json", "intersection_angle", "posterior", "change_arcsec")),
    }
    for name, (unit, digits) in CHANGES.items():
        key = f"{name}_{unit}"
        read = ("recovered.json", "cameras", "backward", "posterior")
        out |= {
            f"launch.{name}_true": (3 if unit == "arcsec" else 1, unit, _at("truth.json", "cameras", "backward", key)),
            f"launch.{name}_read": (digits, unit, _at(*read, key)),
            f"launch.{name}_sigma": (digits, unit, _at(*read, f"{key}_sigma")),
            f"launch.{name}_noise": (4 if digits == 2 else 2, unit, _at(*read, f"{key}_sigma_noise")),
        }
    for name in GROUND:
        ground = ("recovered.json", "ground", "posterior")
        out |= {
            f"launch.{name}_true": (2, "m", _at("truth.json", "ground", f"{name}_m")),
            f"launch.{name}_read": (2, "m", _at(*ground, f"{name}_m")),
            f"launch.{name}_sigma": (2, "m", _at(*ground, f"{name}_m_sigma")),
        }
    return out


def _limits(prior: str) -> dict[str, tuple[int, str, Read]]:
    """Return sigmas of the forward camera before and after a measurement, and of the angle and the height."""
    places = {name: ("forward", f"{name}_{unit}") for name, (unit, _) in CHANGES.items()}
    places |= {"angle": ANGLE, "height": HEIGHT}
    out: dict[str, tuple[int, str, Read]] = {}
    for name, place in places.items():
        unit = {"angle": "arcsec", "height": "m"}.get(name) or CHANGES[name][0]
        below = ("uncertainty.json", "quantities", *place)
        digits = {"um": 1, "m": 2}.get(unit, 3 if name in ("d_alpha", "d_beta", "angle") else 2)
        out[f"{prior}.{name}.before"] = (digits, unit, _at(*below, "before", "sigma"))
        for estimator in ("paper_single", "model", "posterior"):
            out[f"{prior}.{name}.{estimator}"] = (digits, unit, _at(*below, "after", estimator, "sigma"))
    return out


_HEIGHT = ("uncertainty.json", "quantities", *HEIGHT)


def _doubt(of: str) -> Read:
    """Return a reader of the largest elasticity of the height's sigma with respect to the prior."""

    def read(run: Path) -> float:
        height = json.loads((run / "uncertainty.json").read_text("utf-8"))["quantities"]["ground"]["height_m"]
        return float(height["elasticities"][0][of])

    return read


RUNS: Mapping[tuple[str, ...], Mapping[str, tuple[int, str, Read]]] = {
    ("twin.render", "scenes/examples/perturb.yaml", "--seed", "1"): {
        **_readings(),
        "launch.angle_sigma": (2, "arcsec", _at("recovered.json", ANGLE[0], "posterior", "change_arcsec_sigma")),
        "launch.angle_noise": (4, "arcsec", _at("recovered.json", ANGLE[0], "posterior", "change_arcsec_sigma_noise")),
        "launch.angle_share": (0, "%", _share(ANGLE, "base/backward/M2 ")),
        "launch.false_turn": (3, "arcsec", _false_turn),
    },
    ("twin.uncertainty", "gf7_pair"): {
        **_limits("orbit"),
        "orbit.d_alpha.share": (0, "%", _share(("forward", "d_alpha_arcsec"), "base/forward/M2 figure Z7")),
        "orbit.d_gamma.share": (0, "%", _share(("forward", "d_gamma_arcsec"), "base/forward/monitor/")),
        "orbit.d_f.share": (0, "%", _share(("forward", "d_f_um"), "base/forward/M3 figure Z4")),
        "orbit.height.share": (0, "%", _share(HEIGHT, "base/forward/M2 figure Z7")),
        "orbit.height.elasticity": (2, "", _doubt("elasticity")),
        "orbit.height.doubled": (2, "m", _doubt("doubled")),
        "orbit.height.half_width_997": (1, "m", _at(*_HEIGHT, "student_t", "half_width_997")),
        "orbit.height.beyond": (1, "%", _at(*_HEIGHT, "student_t", "beyond_3_sigma", per=100.0)),
    },
    ("twin.uncertainty", "gf7_pair", "--disturbances", "launch"): {
        name: one for name, one in _limits("after_launch").items() if not name.endswith("paper_single")
    },
    **STUDIES,
}
"""Command that makes a run folder -> its figures: decimals, unit, and function that reads each of them there."""


def of_validation(summary: str) -> dict[str, Figure]:
    """Return the figures of a full validation: the checks' measured values, and the number of rows with each verdict.

    Parameters
    ----------
    summary : str
        Text of the page that it writes.
    """
    command = re.findall(r"Made by `(python -m twin\.validate .*?)`", summary)[0]
    seed = int(re.findall(r"--seed (\d+)", command)[0])
    rows: dict[str, str] = {}
    for line in summary.splitlines():
        if line.startswith("| `"):
            cells = line.strip("| ").split(" | ")
            rows |= dict.fromkeys(re.findall(r"`([^`]+)`", cells[0]), cells[4])
    out = {}
    for name, digits, factor, unit in _checks():
        number = _NUMBER.match(rows[name].replace("−", "-"))
        if number is None:
            raise ValueError(f"{name}: no number: {rows[name]}")
        sigma = None if number[2] is None else float(f"{float(number[2]) * factor:.6g}")
        out[name] = Figure(float(f"{float(number[1]) * factor:.6g}"), sigma, unit, digits, command, seed)
    counts = {name: int(n) for name, n in re.findall(r"^\| ([a-z ]+) \| (\d+) \|", summary, re.M)}
    counts["all"] = sum(counts.values())
    for name, number_of in counts.items():
        out[f"rows.{name.replace(' ', '_')}"] = Figure(number_of, None, "", 0, command, seed)
    return out


def _modules() -> dict[str, tuple[Callable[[], Mapping[str, tuple[float, int, str]]], int | None]]:
    """Return prefix of the figures' names -> function that measures them (value, decimals, unit), and its seed.

    These figures are not written by a command. The modules are imported here, since they need the packages of
    ``setup.sh --test``.
    """
    from docs.figures import ccd_growth, libraries, simulated_years

    return {
        "ccd": (ccd_growth.measured, ccd_growth.SEED),
        "loop": (simulated_years.loop_measured, simulated_years.SEED),
        "libraries": (libraries.measured, libraries.SEED),
        "operation": (simulated_years.measured, simulated_years.SEED),
    }


def measure(known: Mapping[str, Figure], only: str = "") -> dict[str, Figure]:
    """Return all figures, measuring again those whose names begin with ``only``."""
    out = dict(known) | {k: v for k, v in of_validation(SUMMARY.read_text("utf-8")).items() if k.startswith(only)}
    for name, (find, seed) in _modules().items():
        if name.startswith(only) or only.startswith(name):
            command = f"python -m docs.figures --only {name}"
            for key, (value, digits, unit) in find().items():
                out[key] = Figure(
                    float(f"{value:.{3 if name == 'libraries' else 6}g}"), None, unit, digits, command, seed
                )
    for words, wanted in RUNS.items():
        if not any(name.startswith(only) for name in wanted):
            continue
        with tempfile.TemporaryDirectory(prefix="figures-") as place:
            run = Path(place, "run")
            subprocess.run([sys.executable, "-m", *words, "--quiet", "--out", str(run)], cwd=ROOT, check=True)
            seed = int(words[words.index("--seed") + 1]) if "--seed" in words else None
            for name, (digits, unit, read) in wanted.items():
                out[name] = Figure(float(f"{read(run):.6g}"), None, unit, digits, f"python -m {' '.join(words)}", seed)
    return out


def read_figures(file: Path = FILE) -> dict[str, Figure]:
    """Return the file's figures by name."""
    tree = read_yaml(file).data if file.exists() else {}
    return {name: Figure(**one) for name, one in tree.items()}


def write_figures(figures: Mapping[str, Figure], file: Path = FILE) -> None:
    """Write the file."""
    yaml = YAML()
    yaml.width = 200
    with file.open("w", encoding="utf-8") as out:
        out.write(HEAD)
        yaml.dump({name: asdict(figures[name]) for name in sorted(figures)}, out)
