"""Legal jobs for an instrument: what moves, from nothing up to the limits, and what is stated of it, true or wrong."""

from __future__ import annotations

import random
from collections.abc import Mapping
from typing import Any

from scenes.specs.load import LIBRARY
from scenes.specs.perturbation import NodeInfo
from scenes.yaml.yaml_file import parse_yaml

STATEMENTS = ("orbit", "orbit", "launch", "launch", "paper_001", "none")
TERMS = ("Z4", "Z5", "Z6", "Z7", "Z8", "Z9", "Z11", "Z22")
LARGEST = {"arcsec": 300.0, "um": 200.0, "nm": 5000.0, "ppm": 1000.0, "K": 60.0}
"""Of what a job may state and a monitor may still follow, and beyond."""


def legal_statement(instrument: int) -> tuple[str, Any]:
    """What is stated to move in all jobs of an instrument: its name, and as plain data if it is not of the library."""
    chance = random.Random(f"hunted statement {instrument}")
    name = chance.choice(STATEMENTS)
    if name != "none" and chance.random() < 0.25:
        return "./stated.yaml", _wrong(chance, name)
    return name, None


def legal_job(instrument: int, number: int, nodes: Mapping[str, NodeInfo]) -> dict[str, Any]:
    """The job of that number for an instrument, the same every time."""
    chance = random.Random(f"hunted job {instrument} {number}")
    job: dict[str, Any] = {
        "instrument": "./instrument.yaml",
        "disturbances": legal_statement(instrument)[0],
        "render": {
            "images": ["spots"],
            "frames": chance.choice((1, 3, 9, 9, 30, 100)),
            "seed": chance.randrange(10**6),
        },
    }
    if chance.random() < 0.15:
        job["analysis"] = {"centroid": chance.choice(("gaussian", "energy"))}
    size = chance.choice((0.0, 1e-3, 1e-2, 1e-2, 0.1, 0.3, 1.0))
    moved = chance.sample(sorted(nodes), chance.choice((1, 1, 1, 2, 4))) if size else []
    job["perturb"] = {path: _moved(chance, nodes[path], size) for path in moved}
    return job


def _moved(chance: random.Random, node: NodeInfo, size: float) -> dict[str, Any]:
    """One to two things that are done to a body, of up to a share of the largest."""

    def number(unit: str) -> str:
        return f"{LARGEST[unit] * size * 10.0 ** chance.uniform(-1.0, 0.0) * chance.choice((-1, 1)):.4g} {unit}"

    def vector(unit: str) -> list[str]:
        parts = [f"0 {unit}"] * 3
        for axis in chance.sample(range(3), chance.choice((1, 1, 3))):
            parts[axis] = number(unit)
        return parts

    def figure() -> dict[str, str]:
        return {term: number("nm") for term in chance.sample(TERMS, chance.choice((1, 1, 2)))}

    make = {
        "rotate": lambda: vector("arcsec"),
        "shift": lambda: vector("um"),
        "scale": lambda: number("ppm"),
        "temperature": lambda: number("K"),
        "figure": figure,
    }
    known = sorted(name for name in make if name in node.allows)
    return {name: make[name]() for name in chance.sample(known, min(len(known), chance.choice((1, 1, 2))))}


def _wrong(chance: random.Random, name: str) -> Any:
    """A statement of the library of which causes are forgotten, or taken for ten or a hundred times less or more."""
    stated = parse_yaml((LIBRARY / "disturbances" / f"{name}.yaml").read_text("utf-8")).data
    causes = stated["causes"]
    for cause in chance.sample(sorted(causes), chance.choice((1, 2, len(causes) - 1))):
        factor = chance.choice((0.0, 0.01, 0.1, 10.0))
        if factor == 0.0:
            del causes[cause]
        else:
            causes[cause] = {
                key: _scaled(value, factor) if key in MOVED else value for key, value in causes[cause].items()
            }
    return stated


MOVED = ("shift", "rotate", "scale", "figure", "temperature")


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, dict):
        return {key: _scaled(part, factor) for key, part in value.items()}
    if isinstance(value, list):
        return [_scaled(part, factor) for part in value]
    number, unit = str(value).split(" ", 1)
    return f"{float(number) * factor:g} {unit}"
