"""MTF of the optics as a measurement of an instrument: values, or ratios of two images of one unknown scene."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import numpy as np
from scipy.linalg import block_diag

from analysis.mtf.mtf_ratio import MtfRatio, mtf_ratio
from analysis.spots.noise import NoiseModel
from optics.geometry.tree import Motion, State, compose_each
from scenes.models.camera_model import focal_plane_body
from scenes.specs.instrument import BASE
from scenes.specs.tolerance import MeritSpec
from twin.asbuilt.measured_kinds import MeasuredKind, View, field_text, field_texts


class MtfReadings(MeasuredKind):
    """Measured MTF of the optics at field points, along the line and along the track.

    With a reference image in another focus, readings are logarithms of the ratio of both MTFs: pixel, detector and
    scene cancel in it, and it changes nearly in proportion to the focus.
    """

    kind = "mtf"
    shown = ("", 1.0)

    def prepare(self) -> None:
        """Set up the evaluator that computes this MTF for the states of the instrument."""
        spec = self.spec
        asked = MeritSpec(kind="mtf", fields=spec.fields, frequency=spec.frequency, at_least=0.0)
        self.tried = self.site.bench({self.name: asked})
        self.plane = focal_plane_body(f"{BASE}/{self.site.camera}")
        ratio = "" if spec.reference_defocus is None else " ln ratio"
        texts = field_texts(spec.fields)
        self.labels = tuple(f"{text} {direction}{ratio}" for text in texts for direction in ("line", "track"))
        self.blocks = tuple(f"field {text}" for text in texts for _ in range(2))

    def predict(self, view: View) -> np.ndarray:
        """Return the MTF of each field and direction in every state, or the logarithm of its ratio."""
        mtf = self._shifted(view.states, self.spec.defocus)
        if self.spec.reference_defocus is None:
            return mtf
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(np.log(mtf / self._shifted(view.states, self.spec.reference_defocus)))

    def _shifted(self, states: Sequence[State], defocus: float) -> np.ndarray:
        """Return the MTF of each field and direction, (S, 2 F), with the focal plane shifted downstream."""
        if not defocus:
            return self.tried.parts_of(states)
        instrument = self.site.experiment.instrument
        bodies = {body.path: body for body in instrument.assembly.tree.bodies}
        shift = {self.plane: Motion(shift=(0.0, 0.0, defocus))}
        return self.tried.parts_of(compose_each([(state, shift) for state in states], bodies))

    def covariance(self) -> np.ndarray:
        """Return the covariance of the readings: that of the ratios of images, or the specified one."""
        if self.spec.pair is None:
            return super().covariance()
        further = (self.spec.sigma or 0.0) ** 2 * np.eye(len(self.labels))
        return np.asarray(block_diag(*(ratio.log_covariance[0] for ratio in self._ratios)) + further)

    def read(self) -> np.ndarray:
        """Return the MTF values in the test's file, or the logarithms of the ratios of its images."""
        if self.spec.pair is not None:
            return np.concatenate([np.log(ratio.ratio[0]) for ratio in self._ratios])
        return np.stack([self.spec.along_line, self.spec.along_track], axis=-1).ravel()

    @cached_property
    def _ratios(self) -> list[MtfRatio]:
        """Ratio of the images of each field."""
        spec = self.spec
        first, second = (self.pages("pair", name) for name in spec.pair)
        pitch = float(self.site.experiment.instrument.cameras[self.site.camera].spec.line.pitch)
        noise = None
        if spec.read_noise is not None:
            noise = NoiseModel(1.0 / spec.gain, spec.read_noise, offset_dn=spec.black_level)
        out = []
        for field, *pages in zip(spec.fields, first, second, strict=True):
            images = pages if noise is not None else [page - spec.black_level for page in pages]
            try:
                out.append(mtf_ratio(images[0], images[1], 1e3 * spec.frequency * pitch, noise=noise))
            except ValueError as error:
                raise self.wrong(f"field {field_text(field)}: {error}", "pair") from error
        return out
