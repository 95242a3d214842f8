"""Finishes of a job's stray light that were measured: their tables at the monitor's wavelength."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from optics.materials.coating_table import CoatingTable
from optics.materials.finish import Finish
from scenes.models.scene_surface import Finishes
from scenes.specs.job_tables import FinishSpec
from scenes.specs.resolved import ResolvedJob
from scenes.yaml.bsdf_file import MeasuredScatter, read_bsdf
from scenes.yaml.coating_file import read_coating

RECIPROCAL_TO = 0.3
"""Rms of the relative difference of a BSDF with its directions exchanged above which is warned."""


@dataclass(frozen=True, eq=False)
class MeasuredFinishes:
    """Measured finishes.

    Attributes:
        finishes: of all surfaces, the measured ones among them.
        scatter: kind of surface -> its table of scattering.
        coatings: kind of surface -> its coating.
    """

    finishes: Finishes
    scatter: Mapping[str, MeasuredScatter]
    coatings: Mapping[str, CoatingTable]

    def to_dict(self) -> dict[str, Any]:
        """What the tables are, for stray.json: kind of surface -> numbers."""
        out: dict[str, dict[str, Any]] = {}
        for kind, scatter in self.scatter.items():
            angles = scatter.table.incidence
            rms = scatter.table.reciprocity()
            out.setdefault(kind, {})["bsdf"] = {
                "incidence_deg": np.degrees(angles).tolist(),
                "total_scatter": [scatter.table.total(float(angle)) for angle in angles],
                "total_scatter_stated": list(scatter.stated),
                "not_reciprocal_rms": None if np.isnan(rms) else rms,
            }
        for kind, coating in self.coatings.items():
            through = coating.transmittance
            out.setdefault(kind, {})["coating"] = {
                "incidence_deg": np.degrees(coating.angles).tolist(),
                "reflectance": coating.reflectance.tolist(),
                "transmittance": None if through is None else through.tolist(),
            }
        return out

    def warnings(self) -> tuple[str, ...]:
        """What the user should know of the tables."""
        out = []
        for kind, scatter in self.scatter.items():
            rms = scatter.table.reciprocity()
            if rms > RECIPROCAL_TO:
                out.append(
                    f"the BSDF of {kind} surfaces is not reciprocal: with its directions exchanged it differs by "
                    f"{100.0 * rms:.0f} % rms; paths take it as measured, for light that arrives as it was lit"
                )
        return tuple(out)


def measured_finishes(resolved: ResolvedJob) -> MeasuredFinishes | None:
    """The finishes that a job has measured; None where there are none.

    Raises:
        InputError: a coating that does not hold the monitor's wavelength, or a table that scatters more than is
            reflected.
    """
    stray = resolved.job.render.stray
    if stray is None or stray.finishes is None:
        return None
    built_in = Finishes()
    changed: dict[str, Finish] = {}
    scatter: dict[str, MeasuredScatter] = {}
    coatings: dict[str, CoatingTable] = {}
    for kind, spec in stray.finishes.given.items():
        key = ("render", "stray", "finishes", kind)
        base = built_in.board if kind == "black" else getattr(built_in, kind)
        if spec.coating is not None:
            try:
                coatings[kind] = read_coating(spec.coating.table).at(resolved.instrument.monitor.wavelength)
            except ValueError as error:
                text = f"the monitor's wavelength is not in the coating's table: {error}"
                raise resolved.job.error(text, (*key, "coating"), found=spec.coating.table) from None
        if spec.bsdf is not None:
            scatter[kind] = read_bsdf(spec.bsdf.table)
        try:
            changed[kind] = _finish(base, spec, kind, scatter.get(kind), coatings.get(kind))
        except ValueError as error:
            allowed = "shares of the incident light, together at most what is reflected"
            raise resolved.job.error(str(error), key, allowed=allowed) from None
    finishes = built_in
    if "mirror" in changed:
        # glass keeps its own: its light arrives from inside, where nobody measures
        finishes = replace(finishes, mirror=changed["mirror"], metallised=built_in.mirror)
    if "black" in changed:
        black = changed["black"]
        finishes = replace(finishes, mirror_back=black, board=black, baffle=black)
    for kind in ("coated", "detector"):
        if kind in changed:
            finishes = replace(finishes, **{kind: changed[kind]})
    return MeasuredFinishes(finishes, scatter, coatings)


def _finish(
    base: Finish, spec: FinishSpec, kind: str, scatter: MeasuredScatter | None, coating: CoatingTable | None
) -> Finish:
    """A built-in finish with what was measured in its place."""
    if kind == "black":
        assert scatter is not None
        return Finish(table=scatter.table, scattered_only=True)
    if spec.reflectance is not None:
        base = replace(base, reflectance=spec.reflectance)
    if coating is not None:
        base = replace(base, coating=coating)
    return base if scatter is None else replace(base, scatter=None, table=scatter.table)
