"""What a simulated pass gives: simulate.json, images, control, the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from optics.backend import Backend
from scenes.units import ANGLE, LENGTH, format_quantity
from twin.artefact import Cell, Table
from twin.orbit.images.flight import Simulation, simulate
from twin.orbit.images.sections import sections
from twin.orbit.images.to_json import to_dict
from twin.trial.result import Advance, LabResult

if TYPE_CHECKING:
    from scenes.orbit_setup import SimulateSetup


def run_simulation(setup: SimulateSetup, backend: Backend, seed: int, advance: Advance) -> LabResult:
    """Fly the pass and put the result together; nothing is traced, so that the backend is not used."""
    advance("images", 0, 2)
    run = simulate(setup, seed)
    advance("images", 1, 2)
    result = simulation_result(run, setup, seed)
    advance("images", 2, 2)
    return result


def simulation_result(run: Simulation, setup: SimulateSetup, seed: int) -> LabResult:
    """Numbers, table and report of a pass."""
    patch = run.spec.patch
    longitude, latitude = np.degrees(run.place)
    images = run.patch.images
    lead = (
        f"{len(images)} images of {patch.lines} lines and {patch.pixels} pixels near "
        f"{latitude:.3f}° N, {longitude:.3f}° E, "
        "with orthophoto, elevation model, the laboratory's camera and the measured orbit and attitude.",
    )
    files = {name: image.frame[None] for name, image in images.items()}
    files |= {"orthophoto": run.patch.control.orthophoto.values[None], "dem": run.patch.control.dem.values[None]}
    return LabResult(
        "simulate",
        "Images of a patch of ground from orbit",
        lead,
        _facts(setup),
        to_dict(run, seed),
        _summary(run),
        sections(run),
        files,
        _warnings(run),
    )


def _summary(run: Simulation) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name, image in run.patch.images.items():
        contrast = 100.0 * float(image.frame.std() / image.frame.mean())
        rows.append((name, *image.sample, *image.nyquist, float(image.frame.mean()), contrast))
    return Table(
        "images",
        "Images",
        "Distance of samples on the ground and modulation transfer at half a cycle per sample, in the patch's middle.",
        ("line", "along line, m", "along track, m", "MTF line", "MTF track", "mean, DN", "contrast, %"),
        rows,
        (None, 3, 3, 3, 3, 1, 1),
    )


def _facts(setup: SimulateSetup) -> tuple[tuple[str, str], ...]:
    test, camera = setup.test, setup.camera
    terrain, light = test.ground.terrain, test.ground.light
    relief = "its own relief" if terrain.relief is None else f"relief {format_quantity(terrain.relief, LENGTH)} rms"
    kind = (
        "Jacksboro fault, 3 arc seconds, moved" if terrain.kind == "real" else f"fractal, exponent {terrain.exponent:g}"
    )
    sun = f"{format_quantity(light.elevation, ANGLE)} high in {format_quantity(light.azimuth, ANGLE)}"
    changes = "; ".join(
        f"{name} f {format_quantity(c.focal_length, LENGTH)}, "
        f"x {format_quantity(c.principal_point[0], LENGTH)}, y {format_quantity(c.principal_point[1], LENGTH)}"
        for name, c in test.changes.items()
    )
    bias = ", ".join(format_quantity(v, ANGLE) for v in test.errors.star_tracker.bias)
    return (
        ("Camera", f"{camera.name}, {camera.description}"),
        ("Changed since the laboratory", changes or "nothing"),
        ("Bias of the star trackers", f"[{bias}]"),
        ("Terrain", f"{kind}; {format_quantity(terrain.height, LENGTH)} high, {relief}"),
        ("Ground", f"cells of {test.ground.texture.spacing:g} m, reflectance {test.ground.texture.mean:g}"),
        ("Sun", sun),
        ("Samples", f"{test.oversampling} along each side of a pixel"),
        ("Description", test.description),
    )


def _warnings(run: Simulation) -> tuple[str, ...]:
    full = [name for name, image in run.patch.images.items() if image.saturated]
    return (f"saturated pixels in {', '.join(full)}; lower ground.texture.mean or the line time",) if full else ()
