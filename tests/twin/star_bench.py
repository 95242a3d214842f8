"""Images of stars by another path than the model that is fitted, and cameras that are drawn, imaged and estimated."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from analysis.instrument_state.state_estimate import combinations
from optics.geometry.tree import State
from optics.numerics.backend import Backend
from optics.numerics.quadrature import PupilNodes, even_disk
from optics.raytrace.system import assemble
from optics.waves.diffraction import Grid, image
from optics.waves.edge_shadow import IlluminatedStop
from optics.waves.imaging import imaging_rays, pupil_field
from scenes.specs.asbuilt import AsBuiltSetup
from scenes.yaml.yaml_file import dump_yaml
from twin.asbuilt.asbuilt_bench import AsBuiltBench
from twin.asbuilt.asbuilt_run import drawn_states
from twin.asbuilt.star_images import ImageReadings

PRIOR = {
    "name": "focused",
    "description": "A camera after its first focus: what mirrors and focal plane may still be off by.",
    "causes": {
        "mirrors": {
            "bodies": "base/*/M?", "shift": ["40 um", "40 um", "10 um"],
            "rotate": ["10 arcsec", "10 arcsec", "0 arcsec"], "time": "constant", "reason": "made up",
        },
        "figures": {
            "bodies": "base/*/M?", "figure": {"Z5": "8 nm", "Z6": "8 nm", "Z9": "4 nm"}, "time": "constant",
            "reason": "made up",
        },
        "plane": {
            "bodies": "base/*/focal_plane", "shift": "80 um", "rotate": "30 arcsec", "time": "constant",
            "reason": "made up",
        },
    },
}  # fmt: skip
"""Prior of the drawn cameras."""
TWO = [[-0.7, 0], [0.7, 0.5]]
RINGS, SHADOW, SUB = 40, 20, 21
"""Rings of the quadrature over the stop, nodes along each side of a shadow, and samples along each side of a pixel."""


def star_bench(
    backend: Backend, folder: Path, defocus: tuple[str, ...], instrument: str = "gf7", **more: object
) -> AsBuiltBench:
    """A camera with images of two stars in one or more positions of the focal plane."""
    (folder / "focused.yaml").write_text(dump_yaml(PRIOR))
    common = {"fields": TWO, "read_noise": 8.0, "pixels": 28, "flux": 1e6, "background": 30.0, **more}
    data = {
        "instrument": instrument,
        "prior": "./focused.yaml",
        "measurements": {"images": {f"focus_{k}": {**common, "defocus": d} for k, d in enumerate(defocus)}},
        "merits": {"wavefront": {"kind": "wavefront", "at_most": 0.0714}},
        "simulate": {},
    }
    (folder / "stars.yaml").write_text(dump_yaml(data))
    return AsBuiltBench(AsBuiltSetup.read(folder / "stars.yaml"), backend)


def independent_share(kind: ImageReadings, number: int, state: State, place: np.ndarray, spiral: int = 0) -> np.ndarray:
    """Shares of a star's light in the pixels of its cut-out, by exact rays of the state through points of a spiral.

    Every ray is a plane wave of its own direction and amplitude (power is conserved along it); waves are summed at
    points of each pixel and averaged. The model that is fitted has polynomials of the wavefront over the nominal
    camera's directions, a square grid, and a Fourier series. With ``spiral``, so many points of the stop lie on a
    spiral, and edges stop their rays; otherwise the points are of a quadrature that ends at the edges.
    """
    beams, path = kind.beams, kind.beams.optics.path
    stop = IlluminatedStop.of(beams.pieces[number : number + 1], RINGS, SHADOW)
    nodes = PupilNodes(stop.x[0], stop.y[0], stop.weight[0])
    if spiral:
        nodes = even_disk(spiral)
        points = np.stack([nodes.x, nodes.y], axis=-1)
        lit = path.rays({}, beams.directions[number : number + 1], points).valid[0]
        nodes = PupilNodes(nodes.x[lit], nodes.y[lit], nodes.weight[lit])
    # the chief ray comes first, without weight
    nodes = PupilNodes(*(np.concatenate([[0.0], part]) for part in (nodes.x, nodes.y, nodes.weight)))
    systems = [assemble(path.assembly, [f"{path.name}/{part}"], [state]) for part in ("imaging", "to_stop")]
    rays = imaging_rays(beams.backend, *systems, beams.directions[number], beams.start[number], path.stop, nodes)
    origin = rays.position[0, 0] + kind.spec.defocus * rays.direction[0, 0]
    field = pupil_field(rays, beams.wavelength, origin)
    step, (rows, columns) = kind.pitch / SUB, kind.shape
    first = [-(0.5 * n + p) * kind.pitch + 0.5 * step for n, p in zip(kind.shape, place, strict=True)]
    # rows along x of the detector, columns along y
    fine = image(field, Grid(first[0], step, rows * SUB), Grid(first[1], step, columns * SUB))[0].T
    return fine.reshape(rows, SUB, columns, SUB).mean(axis=(1, 3)) * kind.pitch**2


def measured(bench: AsBuiltBench, true: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Images of a drawn camera by the independent path, with shot noise and read noise."""
    (state,) = bench.parameters.states(true[None], None)
    out = []
    for kind in bench.kinds:
        assert isinstance(kind, ImageReadings)
        shares = [independent_share(kind, k, state, rng.uniform(-0.5, 0.5, 2)) for k in range(len(kind.stars))]
        light = kind.spec.flux * np.stack(shares) + kind.spec.background
        out.append((rng.poisson(light) + rng.normal(0.0, kind.spec.read_noise, light.shape)).ravel())
    return tuple(out)


DRAWS, RANKS = 199, ((32, 167), (5, 194))
"""Draws of a posterior, and lowest and highest numbers of them below a truth that lies within 68 and 95 %.

Ranks have these probabilities exactly; quantiles of 200 draws contain 67.3 and 94.1 %.
"""


def judged(bench: AsBuiltBench, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw cameras of a uniform and a normal law in turn, image and estimate each, and rank the truth among the draws.

    Returns:
        Whether the truth of the wavefront at nine fields and of six combinations lies within 68 and 95 % of the draws,
        (count, N, 2); p-values of the chi-square, (count,); numbers of modes, (count,).
    """
    inside, p_values, modes = [], [], []
    for number in range(count):
        true = bench.draw(rng, ("uniform", "normal")[number % 2])
        found = bench.estimates(measured(bench, true, rng))
        draws = drawn_states(found, rng, DRAWS)
        exact, parts = bench.merit_parts(true[None], None)[0], bench.merit_parts(draws, None)
        pairs, scale, mean = list(zip(exact, parts.T, strict=True)), found[0].prior.sigma, found[0].prior.mean
        pairs += [(one.of(true, scale, mean), one.of(draws, scale, mean)) for one in combinations(found[0], 6)]
        ranks = [int(np.sum(possible < truth)) for truth, possible in pairs]
        inside.append([[low <= rank <= high for low, high in RANKS] for rank in ranks])
        p_values.append(found[0].whole.p_value)
        modes.append(len(found))
    return np.array(inside), np.array(p_values), np.array(modes)
