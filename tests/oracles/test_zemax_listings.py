"""Zemax' own listings of rays and wavefronts of HSC, DECam and LSST, as batoid's project keeps them for its tests.

They are no part of batoid's package and none of this project: the tests look for tests/testdata beside an installed
source tree of batoid, or in the folder that the variable BATOID_TESTDATA names, and are skipped without.
"""

import os
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from optics.raytrace.system import assemble
from optics.raytrace.trace import make_rays, trace
from scenes.lens.batoid_reader import read_batoid
from scenes.lens.prescription import SEQUENCE, Prescription

pytestmark = pytest.mark.oracle

OVER = np.array([1.0, -1.0, -1.0])
"""batoid's axes in the prescription's."""
HSC = {
    **{"PM": 3, "G1_entrance": 6, "G1_exit": 7, "G2_entrance": 8, "G2_exit": 9, "ADC1_entrance": 11, "ADC1_exit": 12},
    **{"ADC2_entrance": 13, "ADC2_exit": 14, "G3_entrance": 16, "G3_exit": 17, "G4_entrance": 18, "G4_exit": 19},
    **{"G5_entrance": 20, "G5_exit": 21, "F_entrance": 24, "F_exit": 25, "W_entrance": 28, "W_exit": 29, "D": 31},
}
"""Surface of HSC_old.yaml -> its number in Zemax' listing."""
PLACE, COSINE, OPD = 1e-9, 1e-9, 1e-11
"""Metres, and of wavefronts metres too: what batoid reaches, and what the listings' digits allow."""


def listing(name: str) -> str:
    spec = find_spec("batoid")
    beside = [] if spec is None or spec.origin is None else [Path(spec.origin).parents[1] / "tests/testdata"]
    named = os.environ.get("BATOID_TESTDATA")
    for folder in ([Path(named)] if named else []) + beside:
        if (folder / name).is_file():
            content = (folder / name).read_bytes()
            return content.decode("utf-16-le" if b"\0" in content[:100] else "cp1252", "replace")
    pytest.skip("needs batoid's test data; see BATOID_TESTDATA in this file")


def numbers(text: str, columns: int) -> np.ndarray:
    """Rows of a table that have so many numbers in front of what else there is."""
    rows = []
    for line in text.splitlines():
        words = line.split()[:columns]
        try:
            rows.append([float(word) for word in words])
        except ValueError:
            continue
        if len(rows[-1]) < columns:
            rows.pop()
    return np.array(rows)


def traced_ray(text: str) -> dict[int, np.ndarray]:
    """Surface -> its number, place in millimetres and cosines; the real ray stands before the paraxial one."""
    rows: dict[int, np.ndarray] = {}
    for row in numbers(text, 7):
        rows.setdefault(int(row[0]), row)
    return rows


def telescope(name: str, wavelength: float) -> Prescription:
    batoid = pytest.importorskip("batoid")
    return read_batoid(Path(batoid.__file__).parent / "data" / name, wavelength)


def met(
    backend, lens: Prescription, start: np.ndarray, heading: np.ndarray
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Surface -> place and direction behind it of one ray, in the prescription's frame."""
    out = {}
    names = [surface.name for surface in lens.surfaces]
    rays = make_rays(backend, start[None], heading / np.linalg.norm(heading))
    for k, surface in enumerate(lens.surfaces):
        system = assemble(lens.assembly(apertures=False), [names[: k + 1]])
        traced = trace(backend, system, rays, world=True)
        position, direction, _, valid = (a[0, 0] for a in traced.numpy(traced.world))
        assert valid
        out[surface.name] = position, direction
    return out


@pytest.mark.parametrize("ray", [1, 2, 3])
def test_rays_of_hsc(backend, ray: int) -> None:
    rows = traced_ray(listing(f"HSC_raytrace_{ray}.txt"))
    _, x, y, _, dx, dy, dz = rows[1]
    ours = met(backend, telescope("HSC/HSC_old.yaml", 750e-9), OVER * [1e-3 * x, 1e-3 * y, 16.0], OVER * [dx, dy, -dz])
    for name, number in HSC.items():
        place, direction = ours[name]
        np.testing.assert_allclose(OVER * place - [0.0, 0.0, 16.0], 1e-3 * rows[number][1:4], rtol=0, atol=PLACE)
        np.testing.assert_allclose((OVER * direction)[0], rows[number][4], rtol=0, atol=COSINE)
        np.testing.assert_allclose(np.abs(direction), np.abs(rows[number][4:7]), rtol=0, atol=COSINE)


def opd(backend, lens: Prescription, optic, rays, wavelength: float, chief: int) -> np.ndarray:
    """Path on the sphere about the chief ray's image less the chief ray's, metres, positive ahead; NaN where lost.

    Args:
        backend: where to trace.
        lens: the prescription.
        optic: batoid's telescope, for its sphere and its medium.
        rays: batoid's, before the telescope.
        wavelength: of the light.
        chief: number of the chief ray.
    """
    index, radius = float(optic.inMedium.getN(wavelength)), float(optic.sphereRadius)
    heading = OVER * rays.v / np.linalg.norm(rays.v, axis=-1, keepdims=True)
    system = assemble(lens.assembly(apertures=False), [SEQUENCE])
    position, direction, path, valid = (
        a[0] for a in trace(backend, system, make_rays(backend, OVER * rays.r, heading)).numpy()
    )
    away = np.where(valid[:, None], position - position[chief], 0.0)
    along = np.sum(away * direction, axis=-1)
    # batoid's sphere stands behind the image; one as far before it would be 2e-11 m off
    back = -along + np.sqrt(along**2 - np.sum(away**2, axis=-1) + radius**2)
    total = index * (path + back) + np.asarray(rays.t)
    return np.where(valid, total[chief] - total, np.nan)


@pytest.mark.parametrize("field", ["0.0_0.0", "0.0_1.225", "0.0_1.75", "1.176_1.176"])
def test_wavefronts_of_lsst(backend, field: str) -> None:
    """32 x 32 paths, to 10 pm."""
    text, wavelength, count = listing(f"LSST_wf_{field}.txt"), 500e-9, 32
    batoid = pytest.importorskip("batoid")
    optic = batoid.Optic.fromYaml(str(Path(batoid.__file__).parent / "data/LSST/LSST_g_500.yaml"))
    theirs = numbers(text, count)[::-1] * wavelength
    assert theirs.shape == (count, count)
    angles = np.radians([float(value) for value in field.split("_")])
    cosines = batoid.utils.fieldToDirCos(*angles, projection="zemax")
    grid = batoid.RayVector.asGrid(optic=optic, wavelength=wavelength, nx=count, dirCos=cosines)
    chief = count // 2 * (count + 1)
    found = opd(backend, telescope("LSST/LSST_g_500.yaml", wavelength), optic, grid, wavelength, chief)
    seen = theirs != 0.0
    assert np.count_nonzero(seen) > 200
    np.testing.assert_allclose(found.reshape(count, count)[seen], theirs[seen], rtol=0, atol=OPD)
