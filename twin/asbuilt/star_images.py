"""Images of stars as a measurement of an instrument: their pixels in every state, simulated data, files and checks."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from analysis.instrument_state.state_estimate import ConsistencyTest, MeasuredGroup
from optics.numerics.backend import one_blas_thread
from optics.waves.edge_shadow import IlluminatedStop
from optics.waves.pupil_terms import orders, products, slopes
from optics.waves.star_image import StarImage, StarPupil
from scenes.specs import asbuilt as specs
from twin.asbuilt.measured_kinds import MeasuredKind, View, field_texts
from twin.asbuilt.star_readings import FWHM, StarFit, StarReading, centroid
from twin.camera.varied_beams import BeamLight, VariedBeams
from twin.framework.record import Quantity, Record

TYPICAL_SEEING = 1.5
"""Full width at half maximum of the seeing of simulated stars whose seeing the estimate does not know, pixels."""
_MOST_SEEING = 4.0
"""Largest expected standard deviation of a free blur, pixels, for which the model's samples extend far enough."""
_RINGS, _SHADOW = 80, 24
"""Rings of the quadrature over the stop, and nodes along each side of a shadow's box."""
COARSE = 0.1
"""Noise of the first estimate relative to the brightest pixel."""
MOST_OUTSIDE, NEAR = 0.02, 0.25
"""Share of a star's light outside its cut-out, and distance of its centroid from the middle as a share of the width.

The report warns above them.
"""


def star_pupil(beams: VariedBeams, number: int) -> StarPupil:
    """Return the light of a star at a field of traced beams, with the shadows of bodies and edges.

    The light is even over the incoming wavefront: with (u, v) direction cosines at the detector, p points of the
    wavefront and s points of the stop, the amplitude times du dv is sqrt(|d(u, v)/ds| |dp/ds|) ds.

    Parameters
    ----------
    beams : VariedBeams
        Beams of the nominal camera.
    number : int
        Index of the field.
    """
    stop = IlluminatedStop.of(beams.pieces[number : number + 1], _RINGS, _SHADOW)
    table = products(stop.x[0], stop.y[0], beams.degree) @ beams.solve
    starts = beams.designed.aimed[0, 0, number]
    plane = np.linalg.svd(starts[1:] - starts[0], full_matrices=False)[2][:2]
    cosines, launched = beams.cosines[0, number], (starts[1:] - starts[0]) @ plane.T
    along = [matrix @ beams.solve for matrix in slopes(beams.nodes, beams.degree)]
    area = [
        np.abs(np.linalg.det(np.stack([matrix @ values for matrix in along], axis=-1)))
        for values in (cosines, launched)
    ]
    light = stop.weight[0] * (table @ area[1])
    amplitude = stop.weight[0] * (table @ np.sqrt(area[0] * area[1])) / np.sqrt(np.sum(light))
    middle = beams.designed.chiefs[0, number, 1::-1]
    u, v = (table @ cosines - middle).T
    return StarPupil(u, v, amplitude, beams.wavelength)


class ImageReadings(MeasuredKind):
    """Pixels of images of stars, electrons."""

    kind = "images"
    shown = ("e-", 1.0)

    def prepare(self) -> None:
        """Trace the beams and compute the pupils and the matrices from optical paths to wavefront coefficients."""
        spec = self.spec
        self.beams = self.site.beams(spec.fields, planes=True)
        model = self.site.experiment.instrument.cameras[self.site.camera]
        self.pitch, focal = float(model.spec.line.pitch), float(model.paraxial.focal_length)
        self.shape = (spec.pixels, spec.pixels) if spec.file is None else self._recorded.shape[1:]
        free = spec.seeing == specs.FREE
        self.blur = None if free else spec.seeing * abs(focal) / FWHM
        typical = TYPICAL_SEEING * self.pitch / FWHM if self.blur is None else self.blur
        self.pupils = [star_pupil(self.beams, number) for number in range(len(spec.fields))]
        self.rows = []
        for number, pupil in enumerate(self.pupils):
            u, v = (self.beams.cosines[0, number] - self.beams.designed.chiefs[0, number, 1::-1]).T
            self.rows.append(pupil.terms_of_slopes(u, v, self.beams.nodes.weight, self.beams.degree))
        self.along = [matrix @ self.beams.solve for matrix in slopes(self.beams.nodes, self.beams.degree)]
        self.stars = tuple(self._expected(number, typical) for number in range(len(self.pupils)))
        rows, columns = self.shape
        texts = field_texts(spec.fields)
        self.labels = tuple(f"{text} pixel {r} {c}" for text in texts for r in range(rows) for c in range(columns))
        self.blocks = tuple(f"star {text}" for text in texts for _ in range(rows * columns))

    def _expected(self, number: int, blur: float) -> StarReading:
        """Return the image of a star before the measurement, as the nominal camera makes it."""
        spec = self.spec
        most = _MOST_SEEING * self.pitch if self.blur is None else blur
        image = StarImage(self.pupils[number], self.beams.degree, self.shape, self.pitch, blur=most)
        first = StarFit(np.zeros(2), blur, spec.flux, spec.background, np.zeros(self.shape), np.zeros((0, 0)))
        star = StarReading(image, self.blur, first, None, np.ones(self.shape))
        return star.with_noise(star.predict(self._terms(self.beams.designed)[0, number]).model, spec.read_noise)

    def _terms(self, light: BeamLight) -> np.ndarray:
        """Return the coefficients of eikonals over the nominal directions, (S, F, T), that have the rays' intercepts.

        A state changes the directions of its rays. The derivatives of its eikonal with respect to its own directions
        are the intercepts of its rays with the focal plane; an eikonal over the nominal directions with the same
        intercepts has the same image up to the second order of the change.
        """
        leading = np.einsum("sfni,sfi->sfn", light.directions, light.chiefs) - 1.0
        paths = light.eikonals + self.spec.defocus * leading
        slope = np.stack([paths @ matrix.T for matrix in self.along], axis=-1)
        cosines = np.stack([matrix @ light.directions[..., 1::-1] for matrix in self.along], axis=-2)
        intercepts = np.linalg.solve(cosines, slope[..., None])[..., 0].reshape(*paths.shape[:2], -1)
        return np.stack([intercepts[:, f] @ rows.T for f, rows in enumerate(self.rows)], axis=1)

    @property
    def traced_count(self) -> int:
        """Number of wavefront coefficients of all stars."""
        return sum(len(rows) for rows in self.rows)

    def traced(self, view: View) -> np.ndarray:
        """Return the wavefront coefficients of all stars in every state, metres."""
        return self._terms(self.beams.light(view.states)).reshape(len(view.states), -1)

    @one_blas_thread()
    def fits(self, view: View) -> list[StarFit]:
        """Return the images of all stars in one state, with position, flux and background fitted to the pixels."""
        terms = self.traced(view)[0].reshape(len(self.stars), -1)
        return [star.predict(of_star) for star, of_star in zip(self.stars, terms, strict=True)]

    @one_blas_thread()
    def predict(self, view: View) -> np.ndarray:
        """Return the pixels of all stars in every state, electrons."""
        terms = self.traced(view).reshape(len(view.states), len(self.stars), -1)
        return np.array(
            [
                np.concatenate([star.predict(c).model.ravel() for star, c in zip(self.stars, of_state, strict=True)])
                for of_state in terms
            ]
        )

    @one_blas_thread()
    def reading_slope(self, traced: np.ndarray, slope: np.ndarray) -> np.ndarray:
        """Return the derivatives of the pixels, without those that position, flux and background can explain."""
        terms = traced.reshape(len(self.stars), -1)
        directions = slope.reshape(len(self.stars), terms.shape[1], -1)
        return np.concatenate([star.slope(c, d.T) for star, c, d in zip(self.stars, terms, directions, strict=True)])

    def covariance(self) -> np.ndarray:
        """Return the variances of the pixels, squared electrons; infinite for saturated ones."""
        return np.concatenate([star.variance.ravel() for star in self.stars])

    def group(self, values: np.ndarray) -> MeasuredGroup:
        """Return the measurement as the estimate needs it, with the number of quantities fitted to each star."""
        return replace(super().group(values), fitted=self.stars[0].fitted)

    def about(self, values: np.ndarray) -> ImageReadings:
        """Return the measurement with recorded images, with a noise for steps from a distant state.

        A tenth of the brightest pixel: a model that is far from the images cannot be believed to their own noise.
        """
        stars = []
        for star, counts in zip(self.stars, values.reshape(-1, *self.shape), strict=True):
            used = np.isfinite(counts)
            noise = COARSE * float(np.ptp(counts[used]))
            variance = np.where(used, self.spec.read_noise**2 + noise**2, np.inf)
            stars.append(replace(star, counts=np.where(used, counts, 0.0), variance=variance))
        return self._with(stars)

    def _with(self, stars: Iterable[StarReading]) -> ImageReadings:
        out = copy.copy(self)
        out.stars = tuple(stars)
        return out

    def expecting(self, view: View) -> ImageReadings:
        """Return the measurement with the noise of the light that is expected in a state."""
        pairs = zip(self.stars, self.fits(view), strict=True)
        return self._with(star.with_noise(fit.model, self.spec.read_noise) for star, fit in pairs)

    def mirrored(self, traced: np.ndarray) -> np.ndarray:
        """Return the wavefronts whose even part has the opposite sign: without shadows they make the same images."""
        odd = np.sum(orders(self.beams.degree), axis=0) % 2
        return np.where(np.tile(odd, len(self.stars)) == 1, traced, -traced)

    def measured(self, view: View, rng: np.random.Generator) -> np.ndarray:
        """Return simulated images with stars at random places within a pixel, shot noise and read noise."""
        out = []
        for star, terms in zip(self.stars, self.traced(view)[0].reshape(len(self.stars), -1), strict=True):
            share = star.image.pixels(star.image.irradiance(terms), rng.uniform(-0.5, 0.5, 2), star.first.blur)
            light = star.first.flux * np.maximum(share, 0.0) + star.first.background
            out.append(rng.poisson(light) + rng.normal(0.0, self.spec.read_noise, self.shape))
        return np.concatenate(out, axis=None)

    @cached_property
    def _recorded(self) -> np.ndarray:
        """Images of the file in the program's orientation, (F, R, C), electrons; NaN where they are saturated."""
        pages = self.pages("file", self.spec.file)
        for k, page in enumerate(pages):
            if len(np.unique(page[np.isfinite(page)])) < 2:
                raise self.wrong("a page without a star", "file", "different values below saturation", f"page {k}")
        return pages * self.spec.gain

    def read(self) -> np.ndarray:
        """Return the pixels of all images in the file, electrons; NaN where they are saturated."""
        return self._recorded.ravel()

    def residuals(self, view: View) -> list[StarResidual]:
        """Return measured and predicted images of all stars in the estimated state."""
        stars = zip(field_texts(self.spec.fields), self.spec.fields, self.stars, self.fits(view), strict=True)
        return [StarResidual(f"{self.name} {text}", self.name, *star) for text, *star in stars]


@dataclass(frozen=True, eq=False)
class StarResidual:
    """Recorded image of a star beside its prediction in the estimated state.

    Attributes
    ----------
    name : str
        Name of the measurement and field of the star, different for each star.
    measurement : str
        Name of the measurement.
    field : tuple of float
        Field of the star, as fractions of the half field.
    star : StarReading
        Recorded image with the variance of its pixels.
    fit : StarFit
        Prediction.
    """

    name: str
    measurement: str
    field: tuple[float, float]
    star: StarReading
    fit: StarFit

    @property
    def pulls(self) -> np.ndarray:
        """Recorded minus predicted light over its standard deviation, (R, C); NaN for unused pixels."""
        assert self.star.counts is not None
        used = np.isfinite(self.star.variance)
        return np.where(used, (self.star.counts - self.fit.model) / np.sqrt(self.star.variance), np.nan)

    @property
    def test(self) -> ConsistencyTest:
        """Chi-square test of the image about its prediction in the estimated state."""
        degrees = int(np.sum(np.isfinite(self.pulls))) - self.star.fitted
        return ConsistencyTest.of("star", float(np.nansum(self.pulls**2)), degrees)

    @property
    def outside(self) -> float:
        """Share of the star's light outside its cut-out."""
        return 1.0 - float(np.sum(self.fit.model - self.fit.background)) / self.fit.flux

    @property
    def seeing_px(self) -> float:
        """Full width at half maximum of the blur, pixels."""
        return FWHM * self.fit.blur / self.star.image.pitch

    @property
    def chi_square_per_degree(self) -> float:
        """Chi-square of the image per degree of freedom."""
        return self.test.chi_square / max(1, self.test.degrees)

    def warnings(self) -> list[str]:
        """Return warnings on a star that fits badly, is cut or is saturated."""
        out, name = [], f"{self.measurement}: the star at {self.name.removeprefix(f'{self.measurement} ')}"
        if not self.test.passes():
            ratio = f"chi-square {self.chi_square_per_degree:.2f} per degree of freedom"
            out.append(f"{name} does not have the predicted image: {ratio}")
        light = centroid(np.maximum(self.fit.model - self.fit.background, 0.0))
        if self.outside > MOST_OUTSIDE:
            out.append(f"{name} has {100 * self.outside:.0f} % of its light outside its cut-out: use larger cut-outs")
        elif np.max(np.abs(light / self.fit.model.shape)) > NEAR:
            out.append(f"{name} lies at the edge of its cut-out")
        lost = int(np.sum(~np.isfinite(self.star.variance)))
        if lost:
            out.append(f"{name} has {lost} pixels at saturation or without a value, which are not used")
        return out


STAR: Record[StarResidual] = Record(
    "Image of a star, with what is estimated for it.",
    Quantity("measurement", lambda star: star.measurement, "name of the measurement"),
    Quantity("field", lambda star: list(star.field), "as fractions of the half field"),
    Quantity("row_px", lambda star: star.fit.position[0], "from the middle of the cut-out", head="row", decimals=2),
    Quantity("column_px", lambda star: star.fit.position[1], "from its middle", head="column", decimals=2),
    Quantity("flux_e", lambda star: star.fit.flux, "light of the whole star", head="flux [e-]", decimals=0),
    Quantity("background_e", lambda star: star.fit.background, "in a pixel", head="background [e-]", decimals=1),
    Quantity("seeing_px", lambda star: star.seeing_px, "full width at half maximum", head="seeing", decimals=2),
    Quantity("outside", lambda star: star.outside, "share beyond the cut-out", head="outside", shown="percent"),
    Quantity("chi_square", lambda star: star.test.chi_square, "of its pixels", head="chi-square", decimals=1),
    Quantity("degrees", lambda star: star.test.degrees, "degrees of freedom", head="degrees"),
    Quantity("p_value", lambda star: star.test.p_value, "of the chi-square", head="p", decimals=4),
)
"""Numbers of a star in asbuilt.json and in the report."""
