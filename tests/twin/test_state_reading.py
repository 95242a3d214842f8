"""States read one at a time are the main job's, to the bit."""

import numpy as np
import pytest

from optics.geometry.tree import Motion
from optics.raytrace.aim import AimError
from optics.raytrace.trace import BeamMissedError
from scenes.specs.load import EXAMPLES
from scenes.specs.resolved import resolve
from twin.monitor.monitor_experiment import MonitorExperiment
from twin.monitor.observation import StateReader


@pytest.fixture(scope="module")
def job():
    return resolve(EXAMPLES / "perturb.yaml")


@pytest.fixture(scope="module")
def reader(job, backend) -> StateReader:
    return StateReader(MonitorExperiment(job, backend), 2, 5)


@pytest.mark.second
def test_without_noise_the_model_reads_what_its_motions_do(reader) -> None:
    """A shift of a focal plane is a motion of the model's own; what is not linear in it, and the change of the spot's
    shape, are below 1e-3 of it. The same light is the same reading; at rest there is none.
    """
    still = reader.read({}, noise=False)
    assert still.after.shape == still.light.photons.shape
    assert np.abs(still.recovery.shift).max() < 1e-6
    state = {"base/forward/focal_plane": Motion(shift=(1e-5, 0.0, 0.0))}
    one, again = (reader.read(state, noise=False) for _ in range(2))
    assert np.array_equal(one.recovery.shift, again.recovery.shift)
    true = one.truth.cameras["forward"].d_alpha[0]
    read = one.recovery.parameters["forward"]["model"].d_alpha_rad[0]
    assert read == pytest.approx(true, rel=1e-3)


def test_an_impossible_state_is_told_and_the_next_is_read(reader) -> None:
    with pytest.raises((AimError, BeamMissedError)):
        reader.read({"base/forward/focal_plane": Motion(shift=(5e-3, 0.0, 0.0))})
    assert np.abs(reader.read({}, noise=False).recovery.shift).max() < 1e-6
