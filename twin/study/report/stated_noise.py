"""How much of a response's variance is the noise that the runs state for it, and whether that can be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from scenes.specs.study import StudySpec
from scenes.yaml.errors import InputError, Issue, key_text
from twin.run.artefact import significant
from twin.study.report.study_runs import Response, StudyRuns

FALSE_ALARM = 1e-6
"""How often noise that is stated rightly, and all that varies, is called impossible; of a response."""


@dataclass(frozen=True)
class NoiseShare:
    """Noise against all that varies in a response.

    Attributes:
        response: its name.
        share: mean of the stated variances over the variance of the runs. By chance somewhat above 1 where nothing
            but noise varies.
        chance: how often runs vary as little or less where the stated noise is all there is.
    """

    response: str
    share: float
    chance: float

    @property
    def possible(self) -> bool:
        """Whether the stated noise may be a part of what varies."""
        return self.chance >= FALSE_ALARM


def noise_share(response: Response, study: StudySpec) -> NoiseShare | None:
    """The share of a response, None where its noise is not stated, does not vary or nothing varies.

    Of independent normal noise the sum of squares is chi-square; where the runs differ in noise its degrees of freedom
    are those of Satterthwaite, Biometrics Bulletin 2, 110 (1946).
    """
    # noise that all runs have in common is a part of what they do not differ by
    if response.noise is None or study.noise == "shared" or response.constant:
        return None
    stated = response.noise[response.good] ** 2
    stated = stated[np.isfinite(stated)]
    if len(stated) < 2 or not np.any(stated):
        return None
    share = float(np.mean(stated) / np.var(response.known, ddof=1))
    freedom = (len(stated) - 1) * float(np.mean(stated) ** 2 / np.mean(stated**2))
    return NoiseShare(response.name, share, float(stats.chi2.cdf(freedom / share, freedom)))


def impossible(runs: StudyRuns) -> InputError | None:
    """What is wrong with noise that is more than all that varies, each at its key; None where all is possible."""
    study = runs.study
    issues: list[Issue] = []
    for response in runs.responses:
        one = noise_share(response, study)
        if one is None or one.possible:
            continue
        key = study.responses[one.response].noise
        assert key is not None
        times = significant(one.share, 3)
        text = f"states a variance of noise {times} times that of all runs: not the noise of {one.response}"
        remedy = "the standard deviation by noise alone, for readings the key that ends in _sigma_noise"
        found = study.error(text, ("responses", one.response, "noise"), found=key_text(key), allowed=remedy)
        issues += found.issues
    return InputError(*issues) if issues else None
