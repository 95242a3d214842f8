"""Experiments of a test process share what is computed for their instrument; see tests/conftest.py."""

from scenes.specs.job import JobSpec
from scenes.specs.resolved import resolve_job
from twin.monitor.monitor_experiment import MonitorExperiment


def of(disturbances: str) -> JobSpec:
    return JobSpec.model_validate({"instrument": "monitor_pair", "disturbances": disturbances})


def test_an_equal_instrument_is_calibrated_once(experiment, calibrated) -> None:
    first = experiment("monitor_pair")
    # those that earlier tests of this process made may have computed a truth of their own
    calibrated.keep_only(first)
    truth = first.nominal_truth
    again = MonitorExperiment(resolve_job(of("launch")), first.backend)
    assert again.instrument is first.instrument
    assert vars(again)["nominal_truth"] is truth
    # another prior is another statement
    assert "stated" not in vars(again)
    assert again.stated is not None
    assert again.stated.name == "launch"
    halves = MonitorExperiment(resolve_job(of("launch")), first.backend, free_beams=False)
    assert halves.instrument is not first.instrument


def test_a_patched_test_computes_its_own(experiment, monkeypatch) -> None:
    first = experiment("monitor_pair")
    assert MonitorExperiment(first.resolved, first.backend).instrument is not first.instrument
