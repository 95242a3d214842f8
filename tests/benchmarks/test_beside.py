"""The tool that measures speed: it works, and two commits run in turns. Runs of both are drawn, not timed.

What speed rests on and can be told without a clock: kernels compiled once.
"""

import json
from importlib import import_module
from pathlib import Path

import drjit as dr
import pytest
from typer.testing import CliRunner

from tests.benchmarks.__main__ import BENCHMARKS, app
from tests.benchmarks.beside import ROOT, compared, numbers_of, ratios, sources_of
from tests.benchmarks.monitor_speed import random_states
from twin.framework.cli import InputErrorText
from twin.monitor.truth import trace_truth

OLD = Path("/old")


def test_commits_run_in_turns_and_a_busy_machine_is_busy_for_both() -> None:
    """The machine gets slower by half with every turn, and the new sources are twice as fast."""
    order: list[str] = []

    def run(sources: Path, name: str, quick: bool) -> dict[str, float] | None:
        if name == "later" and sources == OLD:
            return None
        order.append("new" if sources == ROOT else "old")
        busy = 1.5 ** ((len(order) - 1) // 2)
        return {"ms": busy * 8.0} if sources == OLD else {"ms": busy * 4.0, "share": 0.5}

    pairs, remarks = compared(["monitor", "later"], OLD, 3, True, lambda text: None, run)
    assert order == ["old", "new", "new", "old", "old", "new"]
    assert pairs == {"monitor.ms": [(8.0, 4.0), (12.0, 6.0), (18.0, 9.0)]}
    assert ratios(pairs["monitor.ms"]) == [0.5] * 3
    assert ratios([(0.0, 1.0), (1.0, 1.0)]) == []
    assert remarks == ["monitor: the older commit has no share", "later: the older commit has no such benchmark"]


def test_what_cannot_be_compared_is_said(monkeypatch, tmp_path) -> None:
    with pytest.raises(InputErrorText, match="no commit nowhere"), sources_of("nowhere"):
        pass

    (tmp_path / "tests").mkdir()
    (tmp_path / "tests/benchmarks.py").write_text("raise ValueError('three')")
    with pytest.raises(InputErrorText, match="ValueError: three"):
        numbers_of(tmp_path, "psf", True)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(InputErrorText, match="--beside needs git"), sources_of("HEAD"):
        pass


@pytest.mark.second
def test_the_command_prints_finite_numbers_and_refuses_unknown_names() -> None:
    done = CliRunner().invoke(app, ["--only", "psf", "--quick", "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["psf"]
    assert found["seconds"] > 0.0
    assert found["difference"] < 1e-3
    wrong = CliRunner().invoke(app, ["--only", "psf,nothing"])
    assert wrong.exit_code == 2
    assert "nothing" in wrong.stderr


@pytest.mark.second
def test_every_benchmark_of_the_list_is_there() -> None:
    pytest.importorskip("uvicorn", reason="the extra `live` is not installed")
    pytest.importorskip("batoid", reason="batoid not installed (extra `oracles`)")
    assert all(callable(import_module(f"tests.benchmarks.{name}_speed").measure) for name in BENCHMARKS)
    files = {file.name.removesuffix("_speed.py") for file in Path(__file__).parent.glob("*_speed.py")}
    assert files == set(BENCHMARKS)


# --- kernels ----------------------------------------------------------------------------------------------------------


@pytest.mark.second
def test_other_numbers_compile_no_new_kernel(experiment, backend) -> None:
    setup = experiment("gf7_pair")

    def work(seed: int) -> None:
        states = random_states(5, seed)
        setup.path.expected_photons(states)
        trace_truth(setup.instrument, backend, states)

    work(1)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        work(2)
        launched = [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]
    assert len(launched) > 5
    assert all(kernel["cache_hit"] for kernel in launched)
