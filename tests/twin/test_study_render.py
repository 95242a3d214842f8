"""The main job as the base of a study, against the command that a user would run by hand."""

from types import SimpleNamespace

import pytest

from scenes.specs.job import PerturbationSpec
from scenes.specs.study import ResponseSpec
from scenes.yaml.errors import InputError
from tests.twin.study_bench import write_study
from twin.main_job.render_job import render_job
from twin.monitor import monitor_experiment
from twin.monitor.monitor_path import MonitorPath
from twin.study.runs.base_job import BlockResult, Failure, Run, leaf, with_values
from twin.study.runs.blocks import check_responses
from twin.study.runs.plan import Plan
from twin.study.runs.render_base import JobMaker, read_job
from twin.study.runs.setup import resolve_study


def numbers(tree, path=()):
    """Key path -> number of everything in results."""
    if isinstance(tree, dict):
        return {key: value for name, below in tree.items() for key, value in numbers(below, (*path, name)).items()}
    return {path: tree}


@pytest.fixture(scope="module")
def study(tmp_path_factory):
    setup = resolve_study(write_study(tmp_path_factory.mktemp("render")))
    return SimpleNamespace(setup=setup, plan=Plan.of(setup))


@pytest.mark.second
def test_one_run_is_what_the_command_gives(study, backend, monkeypatch) -> None:
    """All keys and all numbers of truth.json and recovered.json, by a job file that says the same by hand.

    The command sums the images of its one state in double precision, a study those of its many in single precision;
    here both do the latter.
    """
    real = MonitorPath.photons_of

    def photons(path, state, placed=None, single=False):
        return real(path, state, placed, True)

    monkeypatch.setattr(MonitorPath, "photons_of", photons)
    first = study.plan.run(0)
    (outcome,) = study.setup.job.evaluate(study.setup.tree, [first], backend)
    resolved = read_job(study.setup.tree)
    shift = [value for _, value in reversed(first.values)]
    tree = resolved.plain()
    tree["job"]["perturb"] = {"base/forward/M2": {"shift": [shift[0], "0 um", shift[1]]}}
    tree["job"]["render"]["seed"] = first.seed
    by_hand = render_job(read_job(tree), backend)
    expected = {"truth": by_hand.truth_dict(), "recovered": by_hand.recovered_dict()}
    one, two = numbers(outcome), numbers(expected)
    assert list(one) == list(two)
    assert len(one) > 80
    for key, value in two.items():
        if isinstance(value, float):
            # the same arithmetic on the same numbers: rounding only
            assert one[key] == pytest.approx(value, rel=1e-9, abs=1e-12), key
        else:
            assert one[key] == value, key


@pytest.mark.second
def test_the_same_block_gives_the_same_bits(study, backend, monkeypatch) -> None:
    """Also where its runs, each with noise of its own, are exposed a few at a time."""
    runs = [study.plan.run(number) for number in study.plan.block(1)]
    assert len({run.seed for run in runs}) == len(runs)
    one = study.setup.job.evaluate(study.setup.tree, runs, backend)
    two = study.setup.job.evaluate(study.setup.tree, runs, backend)
    assert one == two
    monkeypatch.setattr(monitor_experiment, "LARGEST_FRAMES", 3 * 9 * 4 * 44 * 48)  # a frame and a fixed pattern each
    assert study.setup.job.evaluate(study.setup.tree, runs, backend) == one


@pytest.mark.second
def test_a_lost_run_fails_alone(study, backend) -> None:
    """A mirror shifted by 3 mm loses the beam; a value outside the schema is refused; the run between them is good."""
    place = ("job", "perturb", "base/forward/M2", "shift", 2)
    runs = [Run(k, ((place, value),), 5) for k, value in enumerate(("3 mm", "1 um", "2 m", "1 arcsec"))]
    lost, good, outside, wrong = study.setup.job.evaluate(study.setup.tree, runs, backend)
    assert isinstance(lost, Failure)
    assert "forward" in lost.message or "spot" in lost.message
    assert good["recovered"]["cameras"]["forward"]["model"]["d_f_um"] != 0.0
    assert isinstance(outside, Failure)
    assert "outside the limits" in outside.message
    assert isinstance(wrong, Failure)


@pytest.mark.second
def test_noise_goes_by_the_seed_alone(study, backend) -> None:
    """Runs without a seed have the base's noise, those with one the same as if they were run alone."""
    place = ("job", "perturb", "base/forward/M2", "shift", 2)
    runs = [Run(k, ((place, "1 um"),), seed) for k, seed in enumerate((None, None, 2, 3))]
    groups = [study.setup.job.evaluate(study.setup.tree, some, backend) for some in (runs, runs[3:])]
    shared, again, own, other, alone = [leaf(one, ("recovered", "cameras", "forward", "model", "d_f_um"))
                                        for group in groups for one in group]  # fmt: skip
    assert (again, alone) == pytest.approx((shared, other), abs=1e-6)
    assert min(abs(own - other), abs(own - shared)) > 1e-3


def test_jobs_made_quickly_are_those_that_the_schema_reads(study) -> None:
    """Every sort of number under perturb, by the short way and by reading the whole job anew."""
    plain = PerturbationSpec(figure={"Z5": "1 nm"}, temperature="0 K").plain()
    tree = with_values(study.setup.tree, [(("job", "perturb", "base/forward/M2"), plain)])
    start = ("job", "perturb", "base/forward/M2")
    values = (
        ((*start, "rotate", 1), "1.5 arcsec"),
        ((*start, "shift", 2), "-0.25 um"),
        ((*start, "figure", "Z5"), "3 nm"),
        ((*start, "scale"), "2 ppm"),
        ((*start, "temperature", "change"), "0.5 K"),
        ((*start, "temperature", "gradient", 0), "0.1 K/m"),
    )
    maker = JobMaker(tree)
    quick = maker.job(values)
    assert quick.job.perturb == read_job(with_values(tree, values)).job.perturb
    assert quick.job.perturb["base/forward/M2"].shift == (0.0, 0.0, -0.25e-6)
    assert quick.plain()["instrument"] == tree["instrument"]
    assert maker.base.job.perturb["base/forward/M2"].shift == (0.0, 0.0, 0.0)
    with pytest.raises(InputError, match="outside the limits"):
        maker.job((((*start, "shift", 2), "1 m"),))


@pytest.mark.second
def test_a_response_may_be_a_difference(study, backend, tmp_path) -> None:
    """What is recovered minus what is true; where one of them is not there, the run fails."""
    outcomes = study.setup.job.evaluate(study.setup.tree, [study.plan.run(k) for k in range(3)], backend)
    key, true = (("recovered", "cameras", "forward", "model", "d_f_um"), ("truth", "cameras", "forward", "d_f_um"))
    asked = {"error": ResponseSpec(key=key, minus=true), "lost": ResponseSpec(key=key, minus=(*true[:-1], "f_um"))}
    result = BlockResult.of(outcomes, {"error": asked["error"]})
    expected = [o["recovered"]["cameras"]["forward"]["model"]["d_f_um"] - leaf(o, true) for o in outcomes]
    assert result.values[:, 0].tolist() == expected
    assert all(result.values[:, 0] != 0.0)
    assert BlockResult.of(outcomes, asked).failed.all()
    # and its noise may be that of the results
    changes = ("sigma: [rec", "noise: [rec"), ("d_f_um_sigma]", "d_f_um_sigma_noise]")
    check_responses(resolve_study(write_study(tmp_path, *changes)), outcomes[0])


@pytest.mark.second
def test_a_response_that_the_results_do_not_have(study, backend, tmp_path) -> None:
    (sample,) = study.setup.job.evaluate(study.setup.tree, [study.plan.run(0)], backend)
    check_responses(study.setup, sample)
    wrong = write_study(tmp_path / "a", ("truth, cameras, forward, d_f_um]", "truth, cameras, forward, d_f_mm]"))
    with pytest.raises(InputError, match=r"responses\.true_df\.key\[3\]: the results of 'render'.*'d_f_um'"):
        check_responses(resolve_study(wrong), sample)
    wrong = write_study(
        tmp_path / "b", ("sigma: [recovered, cameras, forward, model, d_f_um_sigma]", "minus: [truth, d_f_um]")
    )
    with pytest.raises(InputError, match=r"responses\.df\.minus\[1\].*cameras"):
        check_responses(resolve_study(wrong), sample)
    wrong = write_study(tmp_path / "c", ("sigma: [rec", "noise: [rec"))
    alone = r"found recovered\.cameras\.forward\.model\.d_f_um_sigma, .*d_f_um_sigma_noise"
    with pytest.raises(
        InputError, match=rf"study.yaml:8: responses\.df\.noise: not the standard deviation by noise alone.*{alone}"
    ):
        check_responses(resolve_study(wrong), sample)


def test_what_is_stated_of_another_instrument_is_told_before_any_run(tmp_path, backend) -> None:
    setup = resolve_study(write_study(tmp_path))
    causes = {"mine": {"bodies": ["base/rear/M?"], "shift": ["1 um"] * 3, "reason": "r"}}
    tree = {**setup.tree, "disturbances": {"name": "mine", "causes": causes}}
    with pytest.raises(InputError, match=r"disturbances.causes.mine.bodies\[0\]: small has no body"):
        setup.job.check(tree, backend)
