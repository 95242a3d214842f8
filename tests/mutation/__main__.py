"""The mutation test: `python -m tests.mutation --out DIR [--count 400] [--only optics,analysis/orbit] [--json]`."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from scenes.yaml.yaml_file import read_yaml
from tests.mutation.campaign import Mode, Verdict, read_verdicts, run_campaign
from tests.mutation.coverage_map import belongs, measure, read_map
from tests.mutation.mutants import Mutant, mutants_below

HELP = """Put small faults into the source, one at a time, and see whether a test finds each.

A seeded sample of all possible faults is drawn from the physics and the estimators. The tests that run a fault's lines
run in rounds, quick ones first, until a round kills the fault; all killers in that round are recorded. With --first
they end at the first killer, and tests of --without run only where no other test kills the fault: the cheapest way to
the scores with and without them. What survives is either a gap in the tests or changes nothing that can be seen; the
second kind stands in equivalent.yaml with its reason. An interrupted campaign goes on where it was.

Examples:

  python -m tests.mutation --out runs/mutation                           400 faults, some hours on two cores\n
  python -m tests.mutation --out runs/mutation --only optics --count 40  some of them\n
  python -m tests.mutation --out runs/mutation --again                   survivors once more, after new tests\n
  python -m tests.mutation --out runs/mutation --every                   every killer of each fault\n
  python -m tests.mutation --out runs/mutation --first --without @moved  score with and without the tests of a file\n
  python -m tests.mutation --out runs/mutation --without tests/twin/test_live_runs.py    the score without these tests\n

Exit code: 0 at least 90 % of the faults that are not equivalent were found, 1 fewer, 2 bad input.
"""
PLACES = (
    "optics",
    "analysis",
    "twin/monitor/monitor_path.py",
    "twin/monitor/monitor_derivative.py",
    "twin/sensors/area_detector.py",
)
COVERED = ("optics", "scenes", "analysis", "twin")
TESTS = ("optics", "analysis", "oracles", "scenes", "twin")
"""Folders whose tests take part (those of the default tier).

Tests of the commands' robustness, of the papers' verdicts and of speed do not.
"""
LIMIT = 0.90
EQUIVALENT = Path(__file__).with_name("equivalent.yaml")
app = typer.Typer(add_completion=False, rich_markup_mode=None)


def equivalents() -> dict[str, str]:
    """Key -> why no test can tell this mutant from the source."""
    return {entry["key"]: entry["reason"] for entry in read_yaml(EQUIVALENT).data["equivalent"]}


def drawn(every: list[Mutant], count: int, seed: int) -> list[Mutant]:
    """A sample without an order of its own: a mutant is in or out whatever is written elsewhere in the source."""
    return sorted(every, key=lambda one: hashlib.sha256(f"{seed} {one.key}".encode()).digest())[:count]


def without(verdict: Verdict, tests: Collection[str]) -> Verdict:
    """What is left of a verdict if some tests (files, functions or single cases) did not run.

    A killer that has no name, as time that runs out, stays.
    """
    left = tuple(name for name in verdict.killers if not belongs(name, tests))
    return replace(verdict, killers=left, fate="survived" if verdict.killers and not left else verdict.fate)


def summary(verdicts: list[Verdict], known: dict[str, str]) -> dict[str, Any]:
    """Counts, score and survivors as they go into the report."""
    counted = [one for one in verdicts if one.fate == "killed" or one.mutant.key not in known]
    fates = Counter(one.fate for one in counted)
    killed = fates["killed"]
    return {
        "mutants": len(verdicts),
        "equivalent": len(verdicts) - len(counted),
        "killed": killed,
        "survived": fates["survived"],
        "uncovered": fates["uncovered"],
        "score": killed / len(counted) if counted else 1.0,
        "survivors": [
            {
                "key": one.mutant.key,
                "where": f"{one.mutant.path}:{one.mutant.line[0]}",
                "scope": one.mutant.scope,
                "before": one.mutant.before,
                "after": one.mutant.after,
                "fate": one.fate,
            }
            for one in sorted(counted, key=lambda one: (one.mutant.path, one.mutant.line))
            if one.fate != "killed"
        ],
    }


@app.command(help=HELP)
def main(
    out: Annotated[Path, typer.Option(help="Folder for the coverage, the results and the summary.")],
    count: Annotated[int, typer.Option(min=1, help="How many faults.")] = 400,
    only: Annotated[str | None, typer.Option(help="Files or folders of the source, with commas between them.")] = None,
    seed: Annotated[int, typer.Option(help="Which faults are drawn.")] = 1,
    workers: Annotated[int, typer.Option(min=1, help="How many at once.")] = 2,
    quick: Annotated[
        bool, typer.Option("--quick", help="The quickest tests of each fault only; more survive.")
    ] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Try the survivors again, with coverage measured anew.")
    ] = False,
    every: Annotated[
        bool, typer.Option("--every", help="Run all tests that meet a fault, so that every killer is recorded.")
    ] = False,
    first: Annotated[
        bool, typer.Option("--first", help="Stop at the first killer; tests of --without come last.")
    ] = False,
    leave: Annotated[
        str | None,
        typer.Option(
            "--without",
            help="Tests, with commas between them, whose kills do not count; @FILE has one to a line.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the summary as JSON on stdout.")] = False,
) -> None:
    """Measure coverage, draw, try, tell."""
    root = Path.cwd()
    places = tuple(only.split(",")) if only else PLACES
    missing = [place for place in places if not (root / place).exists()]
    if missing:
        typer.echo(f"error: no such file or folder: {', '.join(missing)}; run this in the project's folder", err=True)
        raise typer.Exit(2)
    if every and first:
        typer.echo("error: --every runs all tests and --first ends at a killer; give one of them", err=True)
        raise typer.Exit(2)
    left_out: list[str] = []
    if leave and leave.startswith("@"):
        if not Path(leave[1:]).is_file():
            typer.echo(f"error: --without: no such file: {leave[1:]}", err=True)
            raise typer.Exit(2)
        left_out = Path(leave[1:]).read_text().splitlines()
    elif leave:
        left_out = leave.split(",")
    chosen = drawn(mutants_below(root, places), count, seed)
    folder, results = out / "coverage", out / "results.jsonl"
    out.mkdir(parents=True, exist_ok=True)
    before = read_verdicts(results)
    if again:
        for file in folder.glob("*"):
            file.unlink()
    todo = [one for one in chosen if one.key not in before or (again and before[one.key].fate != "killed")]
    if todo:
        files = [file for name in TESTS for file in sorted((root / "tests" / name).glob("test_*.py"))]
        measure(root, files, COVERED, folder, workers)
        mode: Mode = "every" if every else "first" if first else "round"
        run_campaign(root, todo, read_map(folder, root), results, workers, 1 if quick else 3, mode, left_out)
    verdicts = read_verdicts(results)
    found = summary([without(verdicts[one.key], left_out) for one in chosen], equivalents())
    (out / "summary.json").write_text(json.dumps(found, indent=2) + "\n")
    if as_json:
        typer.echo(json.dumps(found, indent=2))
    else:
        for one in found["survivors"]:
            typer.echo(f"{one['key']} {one['where']} {one['scope']}: {one['before']} -> {one['after']} ({one['fate']})")
        typer.echo(
            f"{found['killed']} of {found['mutants']} killed, {found['survived']} survived, {found['uncovered']} "
            f"uncovered, {found['equivalent']} equivalent: score {100 * found['score']:.1f} %"
        )
    raise typer.Exit(0 if found["score"] >= LIMIT else 1)


if __name__ == "__main__":
    app()
