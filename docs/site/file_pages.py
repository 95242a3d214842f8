"""Pages of the YAML files: every key of every sort of file, with what it means, takes, defaults to, and an example."""

from __future__ import annotations

from pathlib import Path

from docs.site.markdown import anchor, code, prose, sentence, table
from docs.site.spec_examples import Example, example, shipped
from docs.site.spec_keys import Key, Section, sections, summary
from scenes.schema import MODELS
from scenes.specs.load import SCENES

FOLDER = "reference/files"
READ_BY = {
    "job": "`python -m twin.render FILE`; in a script `twin.load(FILE)`; a study's base `render`",
    "measurement": "`python -m twin.recover FILE`",
    "instrument": 'jobs and tests, which name it: `instrument: gf7_pair`; in a script `twin.load("gf7_pair")`',
    "as_built_instrument": "jobs and tests, which name it as their instrument: `instrument: as_built_pair.yaml`",
    "camera": "`python -m twin.camera FILE`; instruments, tests and designs, which name it: `camera: gf7`",
    "camera_design": "`python -m twin.design FILE`",
    "monitor_design": "`python -m twin.design monitor FILE`",
    "detector": "instruments, bands of cameras and lines of payloads, which name it: `detector: monitor_ccd`",
    "disturbances": "jobs, instruments and error budgets, which name it: `disturbances: orbit`",
    "error_budget": "`python -m twin.validate --only 001.table3,001.table4,001.table5`",
    "principle_experiment": "`python -m twin.validate --only 001.table2`",
    "focus_test": "`python -m twin.lab focus FILE`",
    "distortion_test": "`python -m twin.lab distortion FILE`",
    "measured_adjust": "`python -m twin.orbit adjust FILE`",
    "measured_calibration": "`python -m twin.orbit calibrate FILE`",
    "measured_angle": "`python -m twin.orbit angle FILE`",
    "orbit_data": "tests on measurements, which name its folder: `data: DIR`",
    "turntable_test": "`python -m twin.lab turntable FILE`; a distortion test, which names it: `turntable: turntable`",
    "measured_focus": "`python -m twin.lab focus FILE`",
    "measured_distortion": "`python -m twin.lab distortion FILE`",
    "measured_turntable": "`python -m twin.lab turntable FILE`",
    "orbit_adjust": "`python -m twin.orbit adjust FILE`",
    "orbit_angle": "`python -m twin.orbit angle FILE`",
    "orbit_calibration": "`python -m twin.orbit calibrate FILE`",
    "orbit_simulate": "`python -m twin.orbit simulate FILE`",
    "orbit_monitor": "`python -m twin.orbit monitor FILE`",
    "orbit_check": "`python -m twin.orbit check FILE`",
    "orbit_match": "`python -m twin.orbit match FILE`",
    "orbit_jitter": "`python -m twin.orbit jitter FILE`",
    "measured_jitter": "`python -m twin.orbit jitter FILE`",
    "tolerance": "`python -m twin.tolerance FILE`",
    "asbuilt": "`python -m twin.asbuilt FILE`, `python -m twin.asbuilt check FILE`",
    "telemetry": "`python -m twin.operate ingest RECORD FILE`",
    "operation": "`python -m twin.operate init RECORD INSTRUMENT --plan FILE`, `status|forecast RECORD FILE`",
    "three_line_camera": "tests in orbit, which name it: `camera: th1`",
    "study": "`python -m twin.study FILE`",
}
"""Sort of file -> what reads it."""
ORDER = ("job", "instrument", "as_built_instrument", "disturbances", "camera", "detector", "study", "camera_design")
"""Sorts that stand first in the list, what a new user meets first."""


def kinds() -> list[str]:
    """All sorts of file in the order of the list."""
    return sorted(
        MODELS, key=lambda kind: (ORDER.index(kind) if kind in ORDER else len(ORDER), list(MODELS).index(kind))
    )


def file_pages() -> dict[str, str]:
    """Path of a page in the site's source -> Markdown."""
    pages = {f"{FOLDER}/{kind}.md": _page(kind) for kind in kinds()}
    return {f"{FOLDER}/index.md": _index(), **pages}


def title(kind: str) -> str:
    """Title of a kind of file."""
    return kind.replace("_", " ").capitalize()


def _index() -> str:
    rows = [
        [
            f"[{title(kind)}]({kind}.md)",
            prose(sentence(summary(MODELS[kind]))),
            READ_BY[kind],
            ", ".join(code(path.stem) for path in shipped()[kind]),
        ]
        for kind in kinds()
    ]
    return f"""# Files: every key

Every quantity carries its unit, `2 arcsec`; any unit of the same dimension may be written. Three quantities of one
unit may be written in a row, `0 0 3 um`, where a list of them is asked for. A file that names another one does so by
its name in the library or by a path relative to itself. An unknown key is an error with its line and the nearest key
that there is.

These pages are made from the models that check the files. The same models give the JSON Schemas with which an editor
completes keys and marks mistakes while typing: `python -m scenes.schema --out schemas`, then as the first line of a
file `# yaml-language-server: $schema=schemas/job.schema.json`.

{table(["File", "What it says", "Read by", "Shipped"], rows, "files")}
```{{toctree}}
:hidden:

{chr(10).join(kinds())}
```
"""


def _page(kind: str) -> str:
    model = MODELS[kind]
    files = shipped()[kind]
    parts = [f"# {title(kind)}\n\n{prose(sentence(summary(model)))}\n\nRead by {READ_BY[kind]}.\n"]
    parts += [_section(kind, section) for section in sections(model)]
    if files:
        parts.append("## Shipped files\n\n" + "\n".join(_shipped(path, path == _shortest(files)) for path in files))
    return "\n".join(parts)


def _shortest(files: tuple[Path, ...]) -> Path:
    return min(files, key=lambda path: path.stat().st_size)


def _shipped(path: Path, opened: bool) -> str:
    name = path.relative_to(SCENES.parent).as_posix()
    text = path.read_text("utf-8").rstrip()
    opening = " open" if opened else ""
    return f"<details{opening}><summary><code>{name}</code></summary>\n\n```yaml\n{text}\n```\n\n</details>\n"


def _section(kind: str, section: Section) -> str:
    if section.places == ("",):
        head = "## The file"
        said = ""
    else:
        head = f"## {code(section.places[0])}"
        others = section.places[1:]
        said = prose(sentence(section.summary)) + "\n"
        if others:
            said += f"\nThe same at {', '.join(map(code, others))}.\n"
    rows = [_row(kind, section, key) for key in section.keys]
    return f"{head}\n\n{said}\n{table(['Key', 'Meaning', 'Takes', 'Default', 'Example'], rows, 'keys')}"


def _row(kind: str, section: Section, key: Key) -> list[str]:
    place = section.places[0]
    full = f"{place}.{key.name}".lstrip(".")
    if key.takes.below:
        between, _ = key.takes.below[0]
        shown = f"see {code(f'{full}{between}')} below"
        known = example(kind, section, key)
        if not isinstance(known.mapping[key.name], dict | list):
            shown = f"{_shown(known)}, or {shown}"
    else:
        shown = _shown(example(kind, section, key))
    default = "must be written" if key.required else _default(key)
    return [f"{anchor(full)}{code(key.name)}", prose(sentence(key.meaning)), takes_text(key), default, shown]


def _default(key: Key) -> str:
    words = ("none", "empty", "its own defaults")
    return key.default if key.default in words else code(key.default)


def _shown(one: Example) -> str:
    return code(one.text)


def takes_text(key: Key) -> str:
    """What may stand after a key, its units and limits, in a line."""
    units = f"in {', '.join(map(code, key.takes.units))}" if key.takes.units else ""
    what = key.takes.what
    if what.startswith("one of ") or "each one of " in what:
        before, _, names = what.partition("one of ")
        what = f"{before}one of {', '.join(map(code, names.split(', ')))}"
    elif what.startswith(("mapping of the terms", "mapping (")):
        return what
    return "; ".join(part for part in (f"{what} {units}".strip(), key.takes.limits) if part)
