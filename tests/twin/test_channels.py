"""Monitors with other channels than the plain pair, and with mirrors in place of prisms: light, heat, path tracer."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from optics.geometry.tree import Motion, State
from optics.materials.material import material
from optics.numerics.backend import Backend
from optics.thermal.heat import Temperature
from scenes.specs.resolved import resolve
from tests.scenes import monitor_layouts
from tests.tiers import quick
from tests.twin.test_path_tracing import out_and_back
from twin.monitor.monitor_experiment import MonitorExperiment

pytestmark = pytest.mark.second

ARCSEC = np.pi / 648000.0
STATES: list[State] = [
    {},
    {
        "base/forward/M2": Motion(shift=(2e-6, -1e-6, 3e-6)),
        "base/backward/focal_plane": Motion(rotate=(1e-5, 0.0, 2e-5)),
    },
]


def experiment(data: dict[str, Any], folder: Path, backend: Backend) -> MonitorExperiment:
    """From plain data of an instrument, by way of a file."""
    monitor_layouts.write(data, folder / "own.yaml")
    (folder / "job.yaml").write_text("instrument: own.yaml\n", "utf-8")
    return MonitorExperiment(resolve(folder / "job.yaml"), backend)


@pytest.fixture(scope="module")
def two(backend, tmp_path_factory) -> MonitorExperiment:
    return experiment(monitor_layouts.two_beams(), tmp_path_factory.mktemp("two"), backend)


@pytest.fixture(scope="module")
def hollow(backend, tmp_path_factory) -> MonitorExperiment:
    return experiment(monitor_layouts.hollow_pair(), tmp_path_factory.mktemp("hollow"), backend)


# --- light ------------------------------------------------------------------------------------------------------------


def test_a_pair_that_is_written_out_is_the_plain_pair(backend, tmp_path) -> None:
    """Bit by bit: bodies, elements, photons."""
    plain, written = (
        experiment(data, tmp_path, backend) for data in (monitor_layouts.pair(), monitor_layouts.explicit_pair())
    )
    a, b = plain.instrument, written.instrument
    assert a.channels == b.channels
    assert a.assembly.tree.paths == b.assembly.tree.paths
    for what in ("rotation", "translation", "scale"):
        np.testing.assert_array_equal(getattr(a.assembly.place(), what), getattr(b.assembly.place(), what))
    assert dict(a.assembly.sequences) == dict(b.assembly.sequences)
    np.testing.assert_array_equal(plain.path.expected_photons(STATES), written.path.expected_photons(STATES))


def test_the_printed_formulas_are_about_the_pair(two, backend, tmp_path) -> None:
    """Their L and field are those of left and right, not those of the channels that stand farthest out."""
    plain = experiment(monitor_layouts.pair(), tmp_path, backend)
    for camera in plain.instrument.cameras:
        found, wanted = two.geometry(camera), plain.geometry(camera)
        assert (found.separation_m, found.field_beta_rad) == (wanted.separation_m, wanted.field_beta_rad)
        assert found.separation_m < max(c.ccd[1] for c in two.instrument.channels) * 1.99


def test_every_channel_gets_its_light(two) -> None:
    """All spots are whole and in the middle of their CCDs, and get their photons."""
    photons = two.path.expected_photons([{}])[0]
    asked = np.array([c.photons for c in two.instrument.channels])
    # beyond r = v f lambda / (pi D) an Airy pattern has 2 / (pi v) of its light; on the edge of a square of half side h
    # the mean of 1 / r over all directions is 2 sqrt(2) / (pi h); the spot is not quite in the middle of its CCD
    spec = two.instrument.spec.monitor
    half = 0.5 * spec.area_ccd.rows * spec.area_ccd.pitch
    f = np.array([two.instrument.cameras[c.camera].line_principal_distance for c in two.instrument.channels])
    v = np.pi * np.array([c.aperture for c in two.instrument.channels]) * half / (spec.wavelength * f)
    beyond = 2.0 / (np.pi * v) * 2.0 * np.sqrt(2.0) / np.pi
    np.testing.assert_allclose(1.0 - photons.sum(axis=(1, 2)) / asked, beyond, rtol=0.1)
    rows, columns = np.indices(photons.shape[1:])
    for k, axis in enumerate((rows, columns)):
        middle = (photons * axis).sum(axis=(1, 2)) / photons.sum(axis=(1, 2)) - 0.5 * (photons.shape[1 + k] - 1)
        assert np.abs(middle).max() < 1.0


def test_a_channels_own_photons_and_face(backend, tmp_path) -> None:
    """Half the light gives half the image; a narrower face the wider spot that it gives where all are so narrow."""
    data = monitor_layouts.two_beams()
    reference = experiment(data, tmp_path, backend).path.expected_photons([{}])[0]
    site = data["cameras"]["backward"]
    site["channels"]["left_2"] |= {"photons_per_frame": 2.0e6}
    site["channels"]["right"] |= {"return_face": {"aperture": "24 mm"}}
    changed = experiment(data, tmp_path, backend)
    found = changed.path.expected_photons([{}])[0]
    names = [c.key for c in changed.instrument.channels]
    dim, narrow = names.index("backward/left_2"), names.index("backward/right")
    data["monitor"]["return_face"] = {"aperture": "24 mm"}
    all_narrow = experiment(data, tmp_path, backend).path.expected_photons([{}])[0]
    np.testing.assert_allclose(found[narrow], all_narrow[narrow], rtol=0, atol=1e-5 * all_narrow[narrow].max())
    for i in range(len(names)):
        if i == narrow:
            assert found[i].max() < 0.6 * reference[i].max()
        else:
            share = 0.5 if i == dim else 1.0
            np.testing.assert_allclose(found[i], share * reference[i], rtol=0, atol=1e-5 * reference[i].max())


# --- heat -------------------------------------------------------------------------------------------------------------


def test_heat_of_a_channels_prisms_moves_its_spot_alone(two) -> None:
    channel = next(c for c in two.instrument.channels if c.key == "forward/left_2")
    field = Temperature(0.0, (0.0, 0.02, 0.05))
    states = [{}, *(two.thermal.state({channel.prism_body(p): field}) for p in ("prism_180", "prism_0"))]
    place = two.path.coarse_trace(states).centre
    moved = np.linalg.norm(place[:, 1:] - place[:, :1], axis=-1)
    own = two.instrument.channels.index(channel)
    assert np.all(moved[own] > 1e-3)
    np.testing.assert_array_equal(np.delete(moved, own, axis=0), 0.0)


GRADIENT = 22.5e-3
"""K/m, three sigma of paper 001's budget."""


def turned_by_heat(own: MonitorExperiment, prism: str) -> tuple[float, float]:
    """Motion of the spots, arcsec rms on each axis of the CCD, by a gradient along each axis of all channels'
    reflectors; and the largest by 1 K everywhere in them.
    """
    channels = own.instrument.channels
    fields = [Temperature(0.0, tuple(GRADIENT * e)) for e in np.eye(3)] + [Temperature(1.0)]
    states = [own.thermal.state(dict.fromkeys([c.prism_body(prism) for c in channels], field)) for field in fields]
    place = own.path.coarse_trace([{}, *states]).centre
    focal = np.array([own.instrument.cameras[c.camera].line_principal_distance for c in channels])[:, None, None]
    moved = (place[:, 1:] - place[:, :1]) * own.path.pitch / focal / ARCSEC
    return float(np.sqrt(np.mean(np.sum(moved[:, :3] ** 2, axis=(1, 2))) / 2.0)), float(np.abs(moved[:, 3]).max())


def test_frames_keep_what_glass_turns(backend, tmp_path) -> None:
    """What docs/monitor_layout.md says: by how much a gradient turns the beams, in proportion to the expansion of a
    frame; 1 K everywhere turns nothing.
    """
    found = {}
    for name, prisms in (("glass", {}), *((m, {"material": m}) for m in ("CFRP", "SiC", "Zerodur"))):
        data = monitor_layouts.hollow_pair() if prisms else monitor_layouts.pair()
        for prism in ("prism_180", "prism_0"):
            data["monitor"][prism] = {**data["monitor"][prism], **prisms}
        own = experiment(data, tmp_path, backend)
        found[name] = [turned_by_heat(own, prism) for prism in ("prism_180", "prism_0")]
    said = {"glass": (0.095, 0.012), "SiC": (0.036, 0.0033), "CFRP": (0.0016, 0.0002), "Zerodur": (0.0, 0.0)}
    for name, numbers in said.items():
        # as printed, to two digits or one
        np.testing.assert_allclose([turn for turn, _ in found[name]], numbers, rtol=0.03, atol=5e-5)
        # the beam passes the camera's aberrations elsewhere when a reflector has grown
        assert max(still for _, still in found[name]) < 1e-6
    ratio = material("SiC").expansion / material("CFRP").expansion
    for (more, _), (less, _) in zip(found["SiC"], found["CFRP"], strict=True):
        # motions are some microradians, so that second order is some millionths of them
        assert more / less == pytest.approx(ratio, rel=1e-4)


# --- path tracer, pictures --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("layout", quick(1, ["two", "hollow"]))
def test_the_path_tracers_nominal_light_is_the_traced_light(layout, request, backend) -> None:
    """With a reflector turned."""
    instrument = request.getfixturevalue(layout).instrument
    turned = instrument.channels[-1].prism_body("prism_0") + "/mirror_a"
    out_and_back(backend, instrument, {turned: Motion(rotate=(0.0, 2.0 * ARCSEC, 0.0))})
