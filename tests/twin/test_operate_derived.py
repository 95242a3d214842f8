"""What a record keeps besides readings: plans, where an estimate stood, alarms and who has seen them."""

import json
import shutil
from pathlib import Path

import pytest

from scenes.specs.load import EXAMPLES
from scenes.specs.operation import read_operation
from scenes.yaml.errors import Problem
from tests.twin.commands import invoke
from tests.twin.record_bench import MINUTE, START, given, made, temperatures
from tests.twin.study_bench import REFUSED
from twin.operate.__main__ import app
from twin.operate.estimate.operation_model import kept_plan, plan_digest, quantity_names, read_plan
from twin.operate.record.entries import Alarm
from twin.operate.record.history import History

PLAN = "a" * 64


@pytest.fixture(scope="module")
def empty(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("record") / "record"
    made(place).close()
    return place


@pytest.fixture
def record(tmp_path: Path, empty: Path) -> Path:
    return Path(shutil.copytree(empty, tmp_path / "record"))


# --- entries ---------------------------------------------------------------------------------------------


@pytest.mark.second
def test_entries_after_a_place_in_their_order(record: Path) -> None:
    """Two bodies at the same minutes, the second one taken later."""
    with History(str(record)) as history:
        history.take(given("a", temperatures(0, 4)))
        history.take(given("b", temperatures(0, 4, "base/forward")))

        def found(**limits: int) -> list[tuple[int, int]]:
            return [((row["time_us"] - START) // MINUTE, row["id"]) for row in history.entries("", **limits)]

        everything = found()
        assert everything == [(0, 1), (0, 5), (1, 2), (1, 6), (2, 3), (2, 7), (3, 4), (3, 8)]
        at = START + MINUTE
        assert found(after_us=at) == everything[4:]
        assert [row["id"] for row in history.entries("temperature", after_us=at)] == [3, 7, 4, 8]
        with history.reading() as connection:
            plan = connection.exec_driver_sql(
                "EXPLAIN QUERY PLAN SELECT * FROM entry WHERE time_us > 5 ORDER BY time_us, id"
            ).all()
        # without a table of its own to sort in, ten years are read from where they are wanted
        assert len(plan) == 1
        assert "entry_time" in plan[0][-1]


# --- where an estimate stood -----------------------------------------------------------------------------


def test_checkpoints_are_kept_replaced_and_dropped(record: Path) -> None:
    with History(str(record)) as history:
        history.take(given("a", temperatures(0, 3)))
        for k in (1, 0, 2):
            assert history.save_checkpoint(PLAN, k, START + MINUTE * k, 3, b"%d" % k)
        assert history.save_checkpoint(PLAN, 1, START + MINUTE, 3, b"again \0")
        assert history.save_checkpoint("b" * 64, 0, START, 3, b"of another plan")
        assert [(one.number, one.time_us, one.entry_id, one.content) for one in history.checkpoints(PLAN)] == [
            (0, START, 3, b"0"),
            (1, START + MINUTE, 3, b"again \0"),
            (2, START + 2 * MINUTE, 3, b"2"),
        ]
        assert history.drop_checkpoints(PLAN, START + MINUTE) == 2
        assert [one.number for one in history.checkpoints(PLAN)] == [0]
        assert len(history.checkpoints("b" * 64)) == 1


def test_a_reading_drops_what_was_derived_without_it(record: Path) -> None:
    """Whether it is late in its own stream or only comes after those of others."""
    with History(str(record)) as history:
        history.take(given("a", [*temperatures(0, 1), *temperatures(2, 3)]))
        for k in range(5):
            assert history.save_checkpoint(PLAN, k, START + MINUTE * k, 4, b"")
        history.take(given("b", temperatures(5, 1)))
        assert len(history.checkpoints(PLAN)) == 5
        history.take(given("c", temperatures(4, 1, "base/forward")))
        assert [one.number for one in history.checkpoints(PLAN)] == [0, 1, 2, 3]
        assert history.take(given("d", temperatures(1, 1))).new == 0  # it is refused
        assert len(history.checkpoints(PLAN)) == 4
        assert history.take(given("d", temperatures(1, 1)), late=True).new == 1
        assert [one.number for one in history.checkpoints(PLAN)] == [0]


def test_a_checkpoint_that_a_reading_has_overtaken_is_not_kept(record: Path) -> None:
    """Another process took a reading while the estimate was worked out."""
    with History(str(record)) as history:
        history.take(given("a", temperatures(0, 3)))
        history.take(given("b", temperatures(1, 1, "base/forward")))
        assert not history.save_checkpoint(PLAN, 0, START + 2 * MINUTE, 3, b"")
        assert history.save_checkpoint(PLAN, 0, START, 3, b"")
        assert history.save_checkpoint(PLAN, 1, START + 2 * MINUTE, 4, b"")


# --- alarms ----------------------------------------------------------------------------------------------


def test_an_alarm_is_raised_once_and_acknowledged_once(record: Path) -> None:
    with History(str(record)) as history:
        alarm = Alarm("jump", "base/forward/M2", START, "it jumped", {"sigma": 0.5})
        assert history.raise_alarm(alarm)
        assert not history.raise_alarm(Alarm("jump", "base/forward/M2", START, "in other words"))
        assert history.raise_alarm(Alarm("jump", "base/forward/M1", START, "it jumped, too"))
        with pytest.raises(Problem, match="no such alarm"):
            history.acknowledge(3, "Ann", "")
        history.acknowledge(1, "Ann", "after safe mode")
        with pytest.raises(Problem, match="alarm 1 was acknowledged by Ann at "):
            history.acknowledge(1, "Bob", "")
        first, second = history.alarms()
    assert (first["text"], first["content"], first["time_utc"]) == ("it jumped", {"sigma": 0.5}, "2026-01-01T00:00:00Z")
    assert (first["acknowledged"]["by"], first["acknowledged"]["note"]) == ("Ann", "after safe mode")
    assert (second["id"], second["acknowledged"]) == (2, None)


# --- plans -----------------------------------------------------------------------------------------------


@pytest.mark.second
def test_the_newest_plan_counts_and_reads_back(record: Path, tmp_path: Path) -> None:
    file = tmp_path / "plan.yaml"
    first = json.loads(invoke(app, "init", record, "gf7_pair", "--plan", EXAMPLES / "operation.yaml", "--json").stdout)
    again = json.loads(invoke(app, "init", record, "gf7_pair", "--plan", EXAMPLES / "operation.yaml", "--json").stdout)
    assert (first["new_plan"], again["new_plan"]) == (True, False)
    file.write_text("instrument: gf7_pair\ndisturbances: launch\nwindow: 20\n")
    assert "counts" in invoke(app, "init", record, "gf7_pair", "--plan", file).stdout
    with History(str(record)) as history:
        kept = kept_plan(history)
        assert kept == read_plan(file, history)
        assert kept is not None
        assert (kept.operation.window, kept.disturbances.name) == (20, "launch")
        with history.reading() as connection:
            assert connection.exec_driver_sql("SELECT count(*) FROM plan").scalar() == 2


@pytest.mark.second
def test_an_estimate_rests_on_a_part_of_the_plan(tmp_path: Path) -> None:
    text = "instrument: gf7_pair\ndisturbances: in_service\n"

    def digest(more: str) -> str:
        (tmp_path / "plan.yaml").write_text(text + more)
        return plan_digest(read_operation(tmp_path / "plan.yaml"))

    own = digest("")
    assert digest("horizon: 24 h\nrequirements: [{quantity: forward d_f_um, limit: 2 um}]\n") == own
    assert len({own, *(digest(more) for more in ("window: 61\n", "coefficients: 31 percent\n", "mission: 1 h\n"))}) == 4
    shipped = (EXAMPLES.parent / "library/disturbances/in_service.yaml").read_text()
    (tmp_path / "in_service.yaml").write_text(shipped)
    text = text.replace("in_service", "./in_service.yaml")
    assert digest("") == own  # where it stands is no matter
    (tmp_path / "in_service.yaml").write_text(shipped.replace("scale: 5 ppm", "scale: 6 ppm"))
    assert digest("") != own


@pytest.mark.second
@pytest.mark.parametrize(("text", "said"), REFUSED["plans"])
def test_a_plan_that_is_not_of_the_record(text: str, said: str, record: Path, tmp_path: Path) -> None:
    (tmp_path / "plan.yaml").write_text(text)
    result = invoke(app, "init", record, "gf7_pair", "--plan", tmp_path / "plan.yaml")
    assert result.exit_code == 2
    assert said in result.stderr
    with History(str(record)) as history:
        assert history.plan() is None


def test_quantities_are_those_that_are_read() -> None:
    from analysis.monitor.limits import quantities
    from optics.numerics.backend import load_backend
    from twin.monitor.monitor_experiment import MonitorExperiment

    setup = read_operation(EXAMPLES / "operation.yaml")
    experiment = MonitorExperiment(setup.model, load_backend())
    own = quantities(experiment.cameras, experiment.ground)
    assert quantity_names(setup.model.instrument) == tuple(f"{one.group} {one.key}" for one in own)
