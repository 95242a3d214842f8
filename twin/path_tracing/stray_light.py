"""Ghosts and stray light on the area CCDs, added to the wave path's images.

The path tracer (``twin.path_tracing``) gives where light goes by all other ways than the nominal one, as geometric rays
in pixels. That light went through apertures of the same size as the nominal spot's, so that it is spread by the nominal
spot's diffraction image before it is added. Its interference with the nominal light is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from optics.geometry.tree import State
from optics.waves.diffraction import Grid, image
from scenes.models.scenery_parts import Finishes
from scenes.specs.instrument import Channel, prism_of
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.path_tracing.families import Event, Touch, family_name
from twin.path_tracing.path_result import Family
from twin.path_tracing.stray_rays import StrayResult, trace_stray

REACH = 88
"""Pixels from the middle of the diffraction image out to which stray light is spread."""

FAMILIES = 20
"""How many families of each source are listed, the strongest first."""

GHOSTS = 1e-3
"""Share of a spot's light above which ghosts on its area CCD are warned of: a pixel of motion reads wrong by 1e-3 px,
some times the centroid's noise."""


@dataclass(frozen=True, eq=False)
class StrayLight:
    """Stray light of one state.

    Attributes:
        photons: expected photons per pixel and frame beside the nominal spot, (C, rows, columns).
        traced: the path tracer's result.
        paths: traced for every source.
    """

    photons: np.ndarray
    traced: StrayResult
    paths: int

    def share(self, nominal: np.ndarray) -> np.ndarray:
        """Stray over nominal light of every area CCD, (C,)."""
        return np.asarray(self.photons.sum(axis=(1, 2)) / nominal.sum(axis=(1, 2)))

    def to_dict(self) -> dict[str, Any]:
        """Contents of stray.json: by source, the families at any detector and where the light went."""
        out: dict[str, Any] = {}
        for channel, run in self.traced.runs.items():
            families = sorted(self.traced.relative(channel), key=lambda one: -one[1])[:FAMILIES]
            balance = run.balance
            nominal = run.nominal(f"{channel}/area_ccd").touches
            out[channel] = {
                "families": [_family(family, share, sigma, nominal) for family, share, sigma in families],
                "balance": {
                    "emitted": balance.emitted,
                    "absorbed": dict(balance.absorbed),
                    "detected": dict(balance.detected),
                    "escaped": balance.escaped,
                    "under_way": balance.under_way,
                    "relative_error": balance.error,
                },
            }
        return {"paths_per_source": self.paths, "sources": out}


def _family(family: Family, share: float, sigma: float, nominal: tuple[Touch, ...]) -> dict[str, Any]:
    return {
        "detector": family.detector,
        "kind": family.kind,
        "name": family_name(family.touches, nominal),
        "surfaces": [str(touch) for touch in family.touches],
        "relative_to_nominal": share,
        "relative_to_nominal_sigma": sigma,
        "paths": family.count,
        "x_um": 1e6 * family.centroid[0],
        "y_um": 1e6 * family.centroid[1],
        "rms_x_um": 1e6 * family.rms[0],
        "rms_y_um": 1e6 * family.rms[1],
    }


def stray_light(
    experiment: MonitorExperiment,
    state: State,
    paths: int,
    seed: int,
    progress: Callable[[int, int], None] | None = None,
    finishes: Finishes | None = None,
) -> StrayLight:
    """Trace the stray light of all channels in one state.

    Args:
        experiment: the instrument.
        state: what is perturbed.
        paths: of every source.
        seed: of the random numbers.
        progress: told the paths done and in all.
        finishes: what surfaces do with light, None for the built-in ones.

    Raises:
        NominalPathLost: too few paths, or the perturbation moves a beam off.
    """
    from scipy.signal import fftconvolve  # takes long, and most jobs trace no stray light

    instrument = experiment.instrument
    traced = trace_stray(instrument, experiment.backend, state, paths, seed, finishes=finishes, progress=progress)
    spots = diffraction_spots(experiment)
    raw = np.stack([traced.photons[f"{c.key}/area_ccd"] for c in experiment.path.channels])
    spread = np.stack([fftconvolve(light, spot, mode="same") for light, spot in zip(raw, spots, strict=True)])
    return StrayLight(np.maximum(spread, 0.0), traced, paths)  # the transform leaves rounding below zero


def diffraction_spots(experiment: MonitorExperiment) -> np.ndarray:
    """Every channel's diffraction image about its middle, of unit sum, (C, 2 REACH + 1, 2 REACH + 1)."""
    path = experiment.path
    grid = Grid(-REACH * path.pitch, path.pitch, 2 * REACH + 1)
    spots = image(path.fields([{}]), grid, grid, single=True).astype(np.float64)
    return np.asarray(spots / spots.sum(axis=(1, 2), keepdims=True))


@dataclass(frozen=True)
class Ghost:
    """Ghosts on one area CCD that have more than GHOSTS of its own spot's light.

    Attributes:
        channel: whose area CCD it is.
        source: channel that the strongest comes from, ``<camera>/<side>``.
        body: path of the prism that throws it, the first whose face reflects what it should let pass; None where it
            comes from nothing but nominal surfaces in another order.
        text: all in words.
    """

    channel: Channel
    source: str
    body: str | None
    text: str


def ghost_warnings(experiment: MonitorExperiment, light: StrayLight) -> tuple[str, ...]:
    """One warning for each area CCD on which ghosts of any source have more than GHOSTS of its own spot's light."""
    return tuple(ghost.text for ghost in ghosts(experiment, light))


def _thrower(family: Family, usual: tuple[Touch, ...]) -> str | None:
    known = {(touch.part, touch.event) for touch in usual}
    for touch in family.touches:
        prism = prism_of(touch.part)
        if prism is not None and touch.event == Event.REFLECT and (touch.part, touch.event) not in known:
            return f"{touch.part.partition(f'/{prism}/')[0]}/{prism}"
    return None


def ghosts(experiment: MonitorExperiment, light: StrayLight) -> tuple[Ghost, ...]:
    """Area CCDs on which ghosts of any source have more than GHOSTS of their own spot's light.

    Args:
        experiment: the monitor.
        light: traced.
    """
    out, traced = [], light.traced
    for channel in experiment.path.channels:
        name = f"{channel.key}/area_ccd"
        own = traced.runs[channel.key].nominal(name)
        found = [
            (traced.photons_per_power[source] * family.energy / channel.photons, source, family)
            for source, run in traced.runs.items()
            for family in run.families
            if family.detector == name and family.kind == "ghost"
        ]
        total = sum(share for share, _, _ in found)
        if total > GHOSTS:
            share, source, family = max(found, key=lambda one: one[0])
            off = np.hypot(*np.subtract(family.centroid, own.centroid)) / experiment.path.pitch
            usual = traced.runs[source].nominal(f"{source}/area_ccd").touches
            text = (
                f"ghosts on the area CCD of {channel.key} have {100.0 * total:.2g} % of its spot's light and pull the "
                f"spot by that share of what it moves and they do not; the strongest, {100.0 * share:.2g} %, comes "
                f"from {source} by {family_name(family.touches, usual)}, {off:.3g} px from the spot: another tilt of "
                "that prism, or another field, leads it aside"
            )
            out.append(Ghost(channel, source, _thrower(family, usual), text))
    return tuple(out)
