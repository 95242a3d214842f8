"""An instrument of one material that is heated evenly only grows: no angle changes, and no image moves on its pixels.

The growth is exact, so that what is compared agrees to rounding: for every camera of the library, every material,
mirrors, prisms, line and area CCDs, at rest or moved. Light does not grow with the instrument, so that images agree
only as far as diffraction stays. Glass also changes its index; that is looked at by itself, since it is no similarity.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from optics.geometry.tree import Motion, State
from optics.materials.material import MATERIALS, Material, material
from optics.thermal.heat import Temperature
from optics.waves.optical_transfer import polychromatic_transfer
from scenes.models.camera_model import line_body
from scenes.models.instrument_builder import build_instrument
from scenes.models.instrument_model import Instrument
from scenes.models.scenery import build_scenery
from scenes.models.thermal_model import ThermalModel
from scenes.specs.load import load_camera, load_instrument
from twin.monitor.monitor_beams import CcdRays
from twin.monitor.monitor_path import MonitorPath
from twin.monitor.truth import trace_truth
from twin.orbit.flight.line_camera import traced_line_cameras
from twin.targets.target_path import TargetPath

ARCSEC = np.pi / 648000.0
CAMERAS = {"gf7": "gf7_pair", "gf7_conic": "gf7_pair", "gf7_short": "gf7_pair", "monitor": "monitor_pair"}
ALUMINIUM = material("aluminium")
WARMER = 5.0
"""Kelvin: aluminium grows by 1.2e-4 then, a hundred thousand times the rounding of what is measured."""
ROUNDING = 1e-14
"""Radians: some sums of float64 numbers near 1, each good to 1e-16."""
PIXELS = 5e-9
"""Of a spot, pixels: rounding of paths of 40 m to and fro over the pixel of 12 um is 4e-10 for each of many steps."""

MOVED: State = {
    "base/forward/focal_plane": Motion(shift=(60e-6, -90e-6, 20e-6), rotate=(0.0, 20 * ARCSEC, 100 * ARCSEC)),
    "base/forward/M2": Motion(shift=(5e-6, -3e-6, 2e-6), rotate=(1 * ARCSEC, 2 * ARCSEC, 0.0), pivot="centre"),
    "base/backward": Motion(rotate=(2 * ARCSEC, -3 * ARCSEC, 5 * ARCSEC)),
    "base/backward/focal_plane/line": Motion(shift=(10e-6, 200e-6, 0.0)),
    "base/backward/monitor/right/prism_180": Motion(shift=(1e-4, 2e-4, -1e-4), rotate=(30 * ARCSEC, 0.0, 50 * ARCSEC)),
}
"""Lengths and turns of everything that is tried; on a body that has grown the lengths have grown with it."""


@pytest.fixture(scope="module")
def with_camera(backend):
    """Function: camera of the library -> an instrument of the library with two of it.

    A camera longer than the one that an instrument was laid out for has prisms in its light, which nothing here minds.
    """

    @cache
    def build(name: str) -> Instrument:
        spec = load_instrument(CAMERAS[name])
        sites = {key: site.model_copy(update={"camera": name}) for key, site in spec.cameras.items()}
        changed = spec.model_copy(update={"cameras": type(spec.cameras)(sites)})
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("scenes.models.instrument_builder.check_beams", lambda instrument, backend: None)
            return build_instrument(changed, {name: load_camera(name)}, backend)

    return build


def heated(
    instrument: Instrument,
    stuff: Material,
    change: float = WARMER,
    motions: State | None = None,
    index: bool = False,
    only: str = "base",
) -> State:
    """The state in which all of it is of one material, prisms, too, and warmer by ``change``.

    A prism of aluminium keeps the index of its glass; ``index`` tells whether that changes with temperature.
    """
    heat = ThermalModel(instrument)
    heat.materials = dict.fromkeys(heat.materials, stuff)  # type: ignore[misc]
    state = heat.state({only: Temperature(change)}, motions)
    return state if index else {path: replace(motion, index=0.0) for path, motion in state.items()}


def spots(path: MonitorPath, rays: CcdRays) -> np.ndarray:
    """Mean places of the spots, pixels, (C, S, 2)."""
    mean = np.einsum("n,bnk->bk", path.nodes.share, rays.position[..., :2]) / path.pitch
    return mean.reshape(len(path.channels), -1, 2)


# --- nothing changes --------------------------------------------------------------------------------------------------


@pytest.mark.second
@pytest.mark.parametrize("motions", [{}, MOVED], ids=["at rest", "moved"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_no_angle_changes_and_no_spot_moves_on_its_pixels(camera: str, motions: State, with_camera, backend) -> None:
    """Moved, spots lie far off the middle of their CCDs, lines and mirrors are out of place."""
    instrument = with_camera(camera)
    warmed = [(stuff, change) for stuff in MATERIALS.values() for change in (WARMER, -8.0 * WARMER)]
    states = [motions, *(heated(instrument, stuff, change, motions) for stuff, change in warmed)]
    truth = trace_truth(instrument, backend, states)
    assert np.ptp(truth.angle_change) < ROUNDING
    for name, change in truth.cameras.items():
        assert not motions or abs(change.d_alpha[0]) > ARCSEC
        for turn in (change.d_alpha, change.d_beta, change.d_gamma):
            assert np.ptp(turn) < ROUNDING
        assert np.ptp(change.d_f) < ROUNDING * truth.principal_distance[name]
    path = MonitorPath(instrument, backend).coarse
    found, coarse = spots(path, path.rays(states)), path.coarse_trace(states).centre
    assert not motions or np.abs(found).max() > 15.0
    for place in (found, coarse):
        np.testing.assert_allclose(place[:, 1:] - place[:, :1], 0.0, rtol=0, atol=PIXELS)


def test_targets_are_imaged_on_the_same_pixels(with_camera, backend) -> None:
    instrument, grown = with_camera("gf7"), 1.0 + ALUMINIUM.expansion * WARMER
    model = instrument.cameras["backward"]
    path = TargetPath(instrument.assembly, "backward", "base/backward", model, backend)
    places = np.array([[0.11, 0.004], [0.0, -0.003], [-0.08, 0.0]])
    directions = path.directions(places)
    frequency = 0.5 / model.spec.line.pitch * np.array([[1.0, 0.0], [0.0, 1.0], [0.6, 0.3]])
    for motions in ({}, MOVED):
        state = heated(instrument, ALUMINIUM, motions=motions)
        before, after = path.positions(motions, directions), path.positions(state, directions)
        np.testing.assert_allclose(after, before, rtol=0, atol=1e-13)
        maps = [path.local_map(s, directions[0], 1e-3) for s in (motions, state)]
        np.testing.assert_allclose(maps[1].jacobian, maps[0].jacobian, rtol=1e-9, atol=1e-9)
        pupils = [path.pupils(s, directions, before) for s in (motions, state)]
        for one, other in zip(*pupils, strict=True):
            old, new = (
                polychromatic_transfer(pupil, frequency, np.array([colour]), np.ones(1), np.zeros(1))[0]
                # light that has grown, too
                for pupil, colour in ((one, model.spec.wavelength), (other, grown * model.spec.wavelength))
            )
            # what the polynomials leave of both; growth that is left out anywhere is 5e-5
            np.testing.assert_allclose(new, old, rtol=0, atol=1e-7)


@pytest.mark.second
def test_detectors_of_the_path_tracer_have_grown_pixels(with_camera, backend) -> None:
    instrument, grown = with_camera("gf7"), 1.0 + ALUMINIUM.expansion * WARMER
    nominal, warm = (build_scenery(instrument, s) for s in ({}, heated(instrument, ALUMINIUM)))
    for one, other in zip(nominal.detectors, warm.detectors, strict=True):
        assert (one.name, one.rows, one.columns) == (other.name, other.rows, other.columns)
        assert other.pitch == pytest.approx([grown * p for p in one.pitch], rel=1e-15)
    optics = [s for s in nominal.surfaces if s.elements]
    assert len(optics) > 30
    for surface in optics:
        other = warm.surfaces[warm.of_element(surface.elements[0])]
        for mine, its in zip(surface.apertures, other.apertures, strict=True):
            np.testing.assert_allclose(its.bounds, mine.scaled(grown).bounds, rtol=1e-12, atol=1e-15)


# --- what a CCD does by itself ----------------------------------------------------------------------------------------


def test_a_line_that_alone_is_warm_has_larger_pixels(with_camera, backend) -> None:
    """Its pixels see larger angles: the principal distance that they count is shorter by the growth."""
    instrument = with_camera("monitor")
    body = line_body("base/forward")
    state = heated(instrument, ALUMINIUM, only=body)
    truth = trace_truth(instrument, backend, [state])
    size = ALUMINIUM.expansion * WARMER
    change = truth.cameras["forward"]
    # distortion makes the distance 0.17 % longer over the line than at its centre; with the square of the line's length
    assert change.d_f[0] == pytest.approx(-size * truth.principal_distance["forward"], rel=4e-3)
    assert max(abs(change.d_alpha[0]), abs(change.d_beta[0]), abs(change.d_gamma[0])) < ROUNDING
    assert truth.cameras["backward"].d_f[0] == 0.0
    nominal, warm = (traced_line_cameras(instrument, backend, s)["forward"] for s in ({}, state))
    pixel = np.linspace(0.0, nominal.pixels - 1.0, 7)
    middle = 0.5 * (nominal.pixels - 1)
    # a pixel of the grown line lies where another one lay
    inside = np.abs(pixel - middle) * (1.0 + size) < middle
    there = middle + (1.0 + size) * (pixel[inside] - middle)
    np.testing.assert_allclose(warm.look(pixel[inside]), nominal.look(there), rtol=0, atol=ROUNDING)


def test_an_area_ccd_that_alone_is_warm_has_larger_pixels(with_camera, backend) -> None:
    """Places are counted in the chip's own pixels, which the analysis takes to have the nominal pitch."""
    instrument = with_camera("gf7")
    path = MonitorPath(instrument, backend).coarse
    far = {"base/forward/focal_plane": Motion(shift=(80e-6, -120e-6, 0.0))}
    body = instrument.channels[0].ccd_body
    found = spots(path, path.rays([far, heated(instrument, ALUMINIUM, motions=far, only=body)]))
    size = ALUMINIUM.expansion * WARMER
    np.testing.assert_allclose(found[0, 1], found[0, 0] / (1.0 + size), rtol=1e-12)
    assert np.all(np.abs(found[0, 0]) > 10.0)
    np.testing.assert_array_equal(found[1:, 1], found[1:, 0])


# --- glass ------------------------------------------------------------------------------------------------------------


@pytest.mark.second
@pytest.mark.parametrize("camera", ["gf7", "monitor"])
def test_the_index_of_the_prisms_turns_no_beam(camera: str, with_camera, backend) -> None:
    """The change of index is no similarity: it moves beams sideways in tilted prisms, by less than 0.1 um for 5 K.

    Every prism sends the beam out as it came whatever its index, so that spots move only as the wavefront's aberration
    differs between so near parts of the pupil.
    """
    instrument, stuff = with_camera(camera), material("fused silica")
    states = [heated(instrument, stuff, index=index) for index in (False, True)]
    prisms = [motion for path, motion in states[1].items() if path.endswith("/prism_180")]
    assert len(prisms) == 4
    assert all(motion.index > 2e-5 for motion in prisms)
    path = MonitorPath(instrument, backend).coarse
    found = spots(path, path.rays(states))
    moved = np.abs(found[:, 1] - found[:, 0])
    assert 1e-9 < moved.max() < 1e-6
