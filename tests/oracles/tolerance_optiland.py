"""A three-mirror telescope in optiland's tolerancing, with the twenty tolerances that the twin has of it."""

from __future__ import annotations

import time
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from ruamel.yaml import YAML

from scenes.models.camera_model import CameraModel, field_direction
from scenes.specs.load import CAMERAS, LIBRARY
from scenes.specs.tolerance import ToleranceSetup, resolve_tolerance
from tests.oracles.peers import optiland_camera, optiland_rays
from tests.oracles.tolerance_peer import StopNodes

ARCSEC = np.pi / 648_000
MM = 1e-3


def _budget() -> dict[str, tuple[str, str, float, str, int, str | None]]:
    """Name -> motion, limit in the file and in SI; optiland's variable, surface and axis."""
    out: dict[str, tuple[str, str, float, str, int, str | None]] = {}
    for number, (ppm, conic, move, despace, turn) in enumerate(
        ((100, 1e-3, 50, 100, 20), (2000, 1e-2, 50, 100, 20), (5000, 1e-3, 300, None, 20)), start=1
    ):
        mirror = f"M{number}"
        out[f"{mirror}_radius"] = f"{mirror} radius", f"{ppm} ppm", ppm * 1e-6, "radius", number, None
        out[f"{mirror}_conic"] = f"{mirror} conic", f"{conic:.1e}", conic, "conic", number, None
        for axis in "xy":
            out[f"{mirror}_{axis}"] = f"{mirror} shift {axis}", f"{move} um", move * 1e-6, "decenter", number, axis
        if despace is not None:
            out[f"{mirror}_z"] = f"{mirror} shift z", f"{despace} um", despace * 1e-6, "decenter", number, "z"
        for axis in "xy":
            tilt = f"{mirror} rotate {axis}", f"{turn} arcsec", turn * ARCSEC, "tilt", number, axis
            out[f"{mirror}_tilt_{axis}"] = tilt
    return out


BUDGET = _budget()
"""Twenty, so large that every one changes the refocused wavefront by more than ``LEAST``."""


def twin_budget(folder: Path) -> ToleranceSetup:
    """The library's anastigmat after Korsch without its baffle, which optiland does not have; written to a folder."""
    camera = YAML(typ="safe").load((LIBRARY / CAMERAS / "korsch.yaml").read_text("utf-8"))
    del camera["mirrors"]["baffle"]
    YAML().dump(camera, folder / "telescope.yaml")
    lines = [f"  {k}: {{motion: {motion}, limit: {told}, law: uniform}}" for k, (motion, told, *_) in BUDGET.items()]
    head = ["instrument: telescope.yaml", "tolerances:", *lines]
    tail = [
        "compensators: {focus: {motion: focal_plane shift z, range: 100 mm}}",
        "merits: {wavefront: {kind: wavefront, at_most: 0.0714}}",
    ]
    (folder / "budget.yaml").write_text("\n".join([*head, *tail, ""]), "utf-8")
    return resolve_tolerance(folder / "budget.yaml")


class Peer:
    """The telescope in optiland, in millimetres, and its tolerancing with a refocus.

    The light of all fields is traced at once, through the same points of the stop, which is the first mirror. The
    wavefronts of optiland itself need a paraxial exit pupil, which it refuses for a mirror that is tilted.
    """

    def __init__(self, model: CameraModel, fields: np.ndarray) -> None:
        self.model, self.spec, self.nodes = model, model.spec, StopNodes(5)
        self.optic: Any = optiland_camera(model, unit=MM)
        self.optic.set_aperture("EPD", self.spec.entrance_pupil / MM)
        self.optic.fields.set_type("angle")
        half, bias = np.degrees([self.spec.field.x, self.spec.field.y]), np.degrees([0.0, self.spec.field_bias])
        angles = fields * half + bias
        for x, y in angles:
            self.optic.fields.add(x=x, y=y)
        self.shares = angles / self.optic.fields.max_field
        """Fields in optiland's units."""
        self._pupil = -float(self.optic.paraxial.XPL())
        disk = 0.5 * self.spec.entrance_pupil * self.nodes.points
        stop = np.column_stack([disk, model.surfaces["M1"].sag(*disk.T)])
        along = np.array([field_direction(self.spec, x * self.spec.field.x, y * self.spec.field.y) for x, y in fields])
        # to a plane before all mirrors, across each beam
        way = stop @ along.T + 2.0
        self._launch = (stop[None] - way.T[..., None] * along[:, None]).reshape(-1, 3)
        self._along = np.repeat(along, len(stop), axis=0)

    def register(self) -> None:
        """Make the operands known to optiland by which this telescope is toleranced."""
        from optiland.optimization.operand.operand import operand_registry

        for name, function in (
            ("twin_sum", lambda optic: float(np.sqrt(np.sum(self.squares(optic))))),
            ("twin_worst", lambda optic: float(np.sqrt(np.max(self.squares(optic))))),
            ("twin_own", self.own_wavefront),
        ):
            operand_registry.register(name, function, overwrite=True)

    def squares(self, optic: Any) -> np.ndarray:
        """Mean squares of the wavefronts of all fields, waves^2, (F,)."""
        # the stop moves with the first mirror, and the beams with it
        moved = np.array([float(getattr(optic.surfaces[1].geometry.cs, axis)) for axis in "xy"] + [0.0])
        rays = optiland_rays(self._launch / MM + moved, self._along)
        optic.surfaces.trace(rays, record=False)
        beams = (-1, len(self.nodes.points))
        place = np.stack([rays.x, rays.y, rays.z], axis=-1).reshape(*beams, 3)
        heading = np.stack([rays.L, rays.M, rays.N], axis=-1).reshape(*beams, 3)
        return self.nodes.squares(place, heading, rays.opd.reshape(beams), self.spec.wavelength / MM, self._pupil)

    @cached_property
    def gauss(self) -> Any:
        """optiland's own quadrature of a disk, with as many nodes."""
        from optiland.distribution import GaussianQuadrature

        nodes = GaussianQuadrature()
        nodes.generate_points(5)
        return nodes

    def own_wavefront(self, optic: Any, field: tuple[float, float]) -> float:
        """Rms error of one field, waves, by optiland's own wavefront."""
        from optiland.wavefront import Wavefront

        wave = self.spec.wavelength * 1e6
        opd = Wavefront(optic, [field], [wave], 5, self.gauss).get_data(field, wave).opd
        share = self.gauss.weights / np.sum(self.gauss.weights)
        level = np.stack([np.ones_like(opd), self.gauss.x, self.gauss.y], axis=-1)
        rest = opd - level @ np.linalg.solve(level.T @ (level * share[:, None]), level.T @ (share * opd))
        return float(np.sqrt(share @ rest**2))

    def tolerancing(self, precise: bool = False, own: bool = False) -> Any:
        """optiland's tolerancing with a refocus that makes the sum of all mean squares least, without errors as yet.

        Args:
            precise: whether the search goes on to where its differences end, rather than to optiland's default.
            own: whether every field is an operand, of optiland's own wavefront.
        """
        from optiland.optimization.scaling.linear import LinearScaler
        from optiland.tolerancing import Tolerancing

        out = Tolerancing(self.optic, **({"tol": 1e-10} if precise else {}))
        if own:
            for field in self.shares:
                out.add_operand("twin_own", {"optic": self.optic, "field": tuple(field)}, target=0.0)
        else:
            out.add_operand("twin_sum", {"optic": self.optic}, target=0.0)
            out.add_operand("twin_worst", {"optic": self.optic}, target=0.0, weight=0.0)
        # optiland scales a place twice: a unit is 1 m then, and a step of its differences, 1e-8, is 10 nm
        scaler = LinearScaler(factor=np.sqrt(MM), offset=0.0)
        out.add_compensator("decenter", surface_number=len(self.model.surfaces) + 1, axis="z", scaler=scaler)
        return out

    def end(self, name: str, share: float) -> float:
        """Value of optiland's variable where a tolerance is at a share of its limit."""
        _, _, limit, kind, number, axis = BUDGET[name]
        surface = list(self.model.surfaces.values())[number - 1]
        if kind == "radius":
            return float((1.0 + share * limit) / surface.curvature / MM)
        if kind == "conic":
            return float(surface.conic + share * limit)
        if kind == "tilt":
            return share * limit
        return float(self.model.vertex(f"M{number}")["xyz".index(str(axis))] + share * limit) / MM

    def add(self, tolerancing: Any, name: str, sampler: Any) -> None:
        """Add one of the errors."""
        _, _, _, kind, number, axis = BUDGET[name]
        tolerancing.add_perturbation(kind, sampler, surface_number=number, **({"axis": axis} if axis else {}))

    def drawn(self, tolerancing: Any, names: list[str], count: int) -> Any:
        """A Monte Carlo run of optiland's: its table, and the seconds of processor time of each sample."""
        from optiland.tolerancing import DistributionSampler
        from optiland.tolerancing.monte_carlo import MonteCarlo

        for k, name in enumerate(names):
            low, high = sorted((self.end(name, -1.0), self.end(name, 1.0)))
            self.add(tolerancing, name, DistributionSampler("uniform", seed=100 + k, low=low, high=high))
        run = MonteCarlo(tolerancing)
        start = time.process_time()
        run.run(count)
        return run.get_results(), (time.process_time() - start) / count
