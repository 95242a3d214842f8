"""The mutation test: `python -m tests.mutation {measure,draw,run,utterances} ...`."""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import typer

from scenes.yaml.yaml_file import read_yaml
from tests.mutation.campaign import Verdict, read_verdicts, run_campaign
from tests.mutation.coverage_map import measure, read_map
from tests.mutation.fork_server import PACKAGES
from tests.mutation.mutants import KINDS, SLIP, Mutant, mutants_below
from tests.mutation.utterances import utterances_below

HELP = """Put faults into the source, one at a time, and see whether a test finds each.

Faults are slips of the pen (a sign, a term left out) and faults of meaning (a lost root, sigma x 0.8, another unit,
a dropped warning, a refusal passed). A seeded sample goes over all rooms, by their size, and over all kinds; faults
that once survived (planted.yaml) come first. The tests that run a fault's lines run in rounds, quick ones first, until
one fails. What survives is either a gap in the tests or changes nothing that can be seen; the second kind stands in
equivalent.yaml with its reason. An interrupted campaign goes on where it was.

Examples:

  python -m tests.mutation measure --map build/map            once: which tests run which line\n
  python -m tests.mutation run --map build/map --out build/mutation --count 600\n
  python -m tests.mutation run --map build/map --out build/mutation --only optics --count 60 --again\n
  python -m tests.mutation utterances --map build/map         refusals and warnings without a test\n

Exit code: 0 at least 95 % of the faults of meaning and 90 % of the slips that are not equivalent were found and every
utterance has its tests, 1 not so, 2 bad input.
"""
LIMITS = {"meaning": 0.95, SLIP: 0.90}
HERE = Path(__file__).parent
app = typer.Typer(add_completion=False, rich_markup_mode=None, help=HELP)
Map = Annotated[Path, typer.Option("--map", help="Folder of the coverage map.")]


def equivalents() -> dict[str, str]:
    """Key -> why no test can tell this mutant from the source."""
    return {entry["key"]: entry["reason"] for entry in read_yaml(HERE / "equivalent.yaml").data["equivalent"]}


def planted(root: Path) -> list[Mutant]:
    """The faults of planted.yaml, each the only place of its text in its file."""
    found = []
    for entry in read_yaml(HERE / "planted.yaml").data["planted"]:
        source = (root / entry["path"]).read_bytes()
        before = entry["before"].encode()
        if source.count(before) != 1:
            raise ValueError(
                f"planted.yaml: {entry['path']} has {entry['before']!r} {source.count(before)} times, not once"
            )
        start = source.index(before)
        lines = (source[:start].count(b"\n") + 1, source[: start + len(before)].count(b"\n") + 1)
        span = (start, start + len(before))
        found.append(Mutant(entry["path"], "", lines, span, entry["before"], entry["after"], 0, entry["kind"]))
    return found


def room(path: str) -> str:
    """The outermost two folders of a source file."""
    return "/".join(Path(path).parts[:2])


def drawn(every: Iterable[Mutant], count: int, seed: int, slips: float = 1 / 3) -> list[Mutant]:
    """A sample over rooms by their size in possible faults, and within a room over kinds in turn.

    Parameters
    ----------
    every : iterable of Mutant
        All possible faults.
    count : int
        How many at least; every room has one or more.
    seed : int
        Which of them.
    slips : float
        Share of the slips of the pen.
    """
    rooms: dict[str, dict[str, list[Mutant]]] = defaultdict(lambda: defaultdict(list))
    total = 0
    for one in every:
        rooms[room(one.path)][one.kind].append(one)
        total += 1
    chosen: list[Mutant] = []
    for _, kinds in sorted(rooms.items()):
        most = max(1, round(count * sum(map(len, kinds.values())) / max(total, 1)))
        for found in kinds.values():
            found.sort(key=lambda one: hashlib.sha256(f"{seed} {one.key}".encode()).digest())
        plain = kinds.pop(SLIP, [])
        chosen += plain[: round(slips * most)]
        left = most - round(slips * most)
        order = sorted(kinds, key=lambda kind: hashlib.sha256(f"{seed} {kind} {kinds[kind][0].path}".encode()).digest())
        while left and any(kinds.values()):
            for kind in order:
                if left and kinds[kind]:
                    chosen.append(kinds[kind].pop(0))
                    left -= 1
    return chosen


def summary(verdicts: Iterable[Verdict], known: dict[str, str]) -> dict[str, Any]:
    """Counts by kind and room, scores and survivors."""
    verdicts = list(verdicts)
    counted = [one for one in verdicts if one.fate == "killed" or one.mutant.key not in known]
    tables: dict[str, dict[str, Counter[str]]] = {"kinds": defaultdict(Counter), "rooms": defaultdict(Counter)}
    for one in counted:
        tables["kinds"][one.mutant.kind][one.fate] += 1
        kind = SLIP if one.mutant.kind == SLIP else "meaning"
        tables["rooms"][f"{room(one.mutant.path)} {kind}"][one.fate] += 1
    scores = {}
    for kind in LIMITS:
        fates = [one.fate for one in counted if (one.mutant.kind == SLIP) == (kind == SLIP)]
        scores[kind] = fates.count("killed") / len(fates) if fates else 1.0
    return {
        "mutants": len(verdicts),
        "equivalent": len(verdicts) - len(counted),
        "scores": scores,
        **{name: {key: dict(value) for key, value in sorted(table.items())} for name, table in tables.items()},
        "survivors": [
            {
                "key": one.mutant.key,
                "where": f"{one.mutant.path}:{one.mutant.line[0]}",
                "scope": one.mutant.scope,
                "kind": one.mutant.kind,
                "before": one.mutant.before,
                "after": one.mutant.after,
                "fate": one.fate,
            }
            for one in sorted(counted, key=lambda one: (one.mutant.path, one.mutant.line))
            if one.fate != "killed"
        ],
    }


@app.command("measure")
def measured(folder: Map, workers: Annotated[int, typer.Option(min=1)] = 2) -> None:
    """Run all tests once and note which lines each of them runs."""
    if any(folder.glob("*.coverage")):
        typer.echo(f"error: {folder} holds a map already; choose another folder or remove it", err=True)
        raise typer.Exit(2)
    raise typer.Exit(measure(Path.cwd(), folder, workers))


@app.command("run")
def run(
    folder: Map,
    out: Annotated[Path, typer.Option(help="Folder for the results and the summary.")],
    count: Annotated[int, typer.Option(min=1, help="How many faults.")] = 600,
    only: Annotated[str | None, typer.Option(help="Files or folders of the source, with commas between them.")] = None,
    seed: Annotated[int, typer.Option(help="Which faults are drawn.")] = 1,
    workers: Annotated[int, typer.Option(min=1, help="How many at once.")] = 2,
    again: Annotated[bool, typer.Option("--again", help="Try the survivors again, after new tests.")] = False,
    kind: Annotated[str | None, typer.Option(help=f"One kind alone: {', '.join(KINDS)}.")] = None,
    keys: Annotated[
        Path | None, typer.Option(help="File with the keys of the faults to try, in place of a draw.")
    ] = None,
) -> None:
    """Draw faults, try each, tell which survive."""
    root = Path.cwd()
    places = tuple(only.split(",")) if only else PACKAGES
    missing = [place for place in places if not (root / place).exists()]
    if missing:
        typer.echo(f"error: no such file or folder: {', '.join(missing)}; run this in the project's folder", err=True)
        raise typer.Exit(2)
    every = mutants_below(root, places)
    if kind:
        every = [one for one in every if one.kind == kind]
    if keys:
        wanted = set(keys.read_text().split())
        chosen = [one for one in every if one.key in wanted]
    else:
        first = [one for one in planted(root) if one.path.startswith(places) and kind in (None, one.kind)]
        chosen = [*first, *drawn(every, count, seed)]
    out.mkdir(parents=True, exist_ok=True)
    results = out / "results.jsonl"
    before = read_verdicts(results)
    todo = [one for one in chosen if one.key not in before or (again and before[one.key].fate != "killed")]
    # In an order of its own, so that what an interrupted campaign has found is a sample, too.
    todo.sort(key=lambda one: hashlib.sha256(one.key.encode()).digest())
    if todo:
        run_campaign(root, todo, read_map(folder), results, workers)
    verdicts = read_verdicts(results)
    found = summary([verdicts[one.key] for one in chosen], equivalents())
    (out / "summary.json").write_text(json.dumps(found, indent=2) + "\n")
    for one in found["survivors"]:
        what = f"[{one['kind']}]: {one['before']} -> {one['after']} ({one['fate']})"
        typer.echo(f"{one['key']} {one['where']} {one['scope']} {what}")
    told = ", ".join(f"{name} {100 * value:.1f} %" for name, value in found["scores"].items())
    typer.echo(f"{found['mutants']} faults, {found['equivalent']} of the survivors equivalent; found: {told}")
    raise typer.Exit(0 if all(found["scores"][name] >= limit for name, limit in LIMITS.items()) else 1)


@app.command("utterances")
def utterances(
    folder: Map, only: Annotated[str | None, typer.Option(help="Files or folders of the source.")] = None
) -> None:
    """List the refusals and warnings that no test sees, or sees absent."""
    known = read_map(folder)
    bare = every = 0
    for one in utterances_below(Path.cwd(), tuple(only.split(",")) if only else PACKAGES):
        every += 1
        seen, absent = one.tests(known)
        if not seen or not (absent or one.always):
            bare += 1
            typer.echo(f"{one.path}:{one.line}\t{one.scope}\tseen by {len(seen)}, absent in {len(absent)}\t{one.text}")
    typer.echo(f"{every} utterances, {bare} without a test that sees them and one that sees them absent")
    raise typer.Exit(1 if bare else 0)


if __name__ == "__main__":
    app()
