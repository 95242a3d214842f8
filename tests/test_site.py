"""The documentation's site: the reference leaves nothing out, its examples are right, and its links lead somewhere."""

import inspect
import json
import re
from pathlib import Path

import pytest

import twin
from docs.site.__main__ import HERE, NEEDED, BuildError, Progress, app, build, run_sphinx, with_policy
from docs.site.command_pages import command_page, commands, programs
from docs.site.file_pages import ACTIONS, file_pages, key_page, node_table
from docs.site.markdown import slug
from docs.site.run_pages import described, golden_runs
from docs.site.spec_keys import accepted, example, flow, keys, kinds_of, sections, shipped
from scenes.schema import MODELS, json_schema
from scenes.yaml.yaml_file import parse_yaml
from tests.twin.commands import invoke
from twin.framework.page import checksum

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="module")
def pages() -> dict[str, str]:
    return file_pages()


# --- keys of files ---------------------------------------------------------------------------------------


def rows(page: str) -> dict[str, str]:
    """Place of a key -> its row in the page's tables."""
    return {found[1]: found[0] for found in re.finditer(r'^\| <span id="([^"]+)"></span>.*$', page, re.M)}


@pytest.mark.second
def test_every_key_stands_in_the_reference(pages: dict[str, str]) -> None:
    """In one table, each row with all five columns filled; by the JSON Schemas, which pydantic makes."""
    for kind in MODELS:
        schema, found = json_schema(kind), rows(pages[f"reference/files/{kind}.md"])
        # a mapping may stand in the place of another file, which has a page of its own
        others = {model.__name__ for model in MODELS.values()}
        parts, waiting = {}, [("", schema | {"$defs": {}})]
        while waiting:
            name, part = waiting.pop()
            parts[name] = part
            named = set(re.findall(r'"#/\$defs/(\w+)"', json.dumps(part))) - parts.keys() - others
            waiting += [(one, schema["$defs"][one]) for one in sorted(named)]
        keys = [key for part in parts.values() for key in part.get("properties", {})]
        assert sorted(place.split(".")[-1] for place in found) == sorted(map(slug, keys)), kind
        for row in found.values():
            cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", row)[1:-1]]
            assert len(cells) == 5, row
            assert all(cells), row


@pytest.mark.second
def test_the_page_of_all_keys_is_that_of_the_models() -> None:
    """``python -m docs.site --keys docs/keys.md`` writes it."""
    assert (ROOT / "docs/keys.md").read_text("utf-8") == key_page()


def test_every_example_is_taken_by_its_model() -> None:
    """As it is shown: the line is read as YAML and put into the mapping that it is an example in."""
    for kind, model in ((kind, model) for kind, file in MODELS.items() for model in sections(file)):
        for key in keys(model):
            mapping = example(kind, model, key.name)
            data = parse_yaml(f"{key.name}: {flow(mapping[key.name])}\n").data
            assert list(data) == [key.name]
            assert accepted(model, {**mapping, **data}), data
            assert not accepted(model, {**mapping, "no_such_key": 1})
    (model,) = (model for model in sections(MODELS["job"]) if model.__name__ == "RenderSpec")
    mapping = example("job", model, "frames")
    assert not accepted(model, {**mapping, "frames": 0})
    assert not accepted(model, {**mapping, "frames": "9 s"})


def test_a_value_in_one_line_of_yaml_reads_back() -> None:
    texts = ["2 um", "name", "a: b", "# no comment", "null", "true", "1.5", "", "-", "[x", "it's"]
    for value in (*texts, 7, 0.1, True, ["a, b", {"k": "v: w"}]):
        assert parse_yaml(f"x: {flow(value)}\n").data == {"x": value}


@pytest.mark.second
def test_every_sort_of_file_says_what_reads_it_and_ships_an_example(pages: dict[str, str]) -> None:
    assert all(shipped().values())
    for kind, files in shipped().items():
        page = pages[f"reference/files/{kind}.md"]
        read = re.search(r"^Read (.*)\.$", page, re.M)[1]
        for line in re.findall(r"python -m ([\w.]+(?: [a-z]+)?)", read):
            assert line in commands(line.split(" ")[0])
        for file in files:
            assert kinds_of(file) == (kind,)
            assert file.read_text("utf-8").rstrip() in page


# --- nodes, commands, library ----------------------------------------------------------------------------


def test_every_node_stands_in_the_reference(gf7_pair) -> None:
    table = node_table("gf7_pair", gf7_pair.nodes)
    for path, info in gf7_pair.nodes.items():
        row = next(line for line in table.splitlines() if f"`{path}`" in line)
        cells = [cell.strip() for cell in row.split("|")[1:-1]]
        assert {action for action, mark in zip(ACTIONS, cells[1:-1], strict=True) if mark} == set(info.allows)
        assert set(re.findall(r"`(\w+)`", cells[-1])) == {"origin", *info.pivots}


def test_on_a_phone_every_column_of_a_node_has_its_own_name() -> None:
    """The style sheet names the cells of a row by their position."""
    style = (HERE / "static" / "site.css").read_text("utf-8")
    for k, name in enumerate((*ACTIONS, "pivots"), 2):
        assert f'table.nodes td:nth-child({k})::before {{ content: "{name} "; }}' in style
    assert f"nth-child(-n + {len(ACTIONS) + 1})" in style


def test_every_command_and_every_option_stands_in_the_reference() -> None:
    page = command_page()
    assert {"twin.render", "twin.lab", "twin.orbit", "twin.study", "twin.design", "twin.validate", "twin.doctor",
            "twin.uncertainty", "twin.live", "twin.recover", "analysis.mtf",
            "scenes.schema"} <= set(programs())  # fmt: skip
    for program in programs():
        assert f"## `{program}`" in page
        for words, command in commands(program).items():
            section = page[page.index(f"# `{words}`") :].split("\n## ")[0].split("\n### ")[0]
            # as --help finds them, the text of which stands above the table
            options = [
                name for param in command.params for name in (*param.opts, *param.secondary_opts) if name[0] == "-"
            ]
            assert options
            assert all(f"`{name}`" in section for name in options)
            assert set(re.findall(r"^\| .*?`(--[\w-]+)`", section, re.M)) <= set(options)


def test_everything_in_the_library_stands_in_the_reference_and_has_a_docstring() -> None:
    page = (HERE / "pages/reference/api.md").read_text("utf-8")
    for name in twin.__all__:
        assert f"## `twin.{name}`" in page
        thing = getattr(twin, name)
        assert inspect.getdoc(thing)
        if inspect.isclass(thing):
            public = [member for key, member in vars(thing).items() if not key.startswith("_")]
            assert all(inspect.getdoc(member) for member in public)


def test_every_file_of_a_run_folder_is_described() -> None:
    for command, files in golden_runs().items():
        assert described(command)
        assert files
    golden_runs()["twin.camera"]["strange.json"] = []
    try:
        with pytest.raises(LookupError, match=r"strange\.json"):
            described("twin.camera")
    finally:
        del golden_runs()["twin.camera"]["strange.json"]


# --- the site --------------------------------------------------------------------------------------------


FAULTS = {
    "[x](docs/gone.md)": "cross-reference target not found: 'docs/gone.md'",
    "[x](docs/there.md#nowhere)": "local id not found in doc 'docs/there': 'nowhere'",
    "[x](#nowhere)": "cross-reference target not found: 'nowhere'",
    "[x](scenes)": "cross-reference target not found: 'scenes'",
    "![x](docs/gone.png)": "image file not readable: docs/gone.png",
}
"""Markdown -> what Sphinx says of it."""


@pytest.mark.second
def test_a_broken_site_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sphinx colours its output where CI is set; progress and messages are plain text there too."""
    monkeypatch.setenv("CI", "1")
    for name in NEEDED:
        pytest.importorskip(name)
    tree = "```{toctree}\ndocs/there\n```\n"
    (tmp_path / "a/docs").mkdir(parents=True)
    (tmp_path / "a/index.md").write_text("\n\n".join(["# Index", *FAULTS, "[x](docs/there.md#here)", tree]))
    (tmp_path / "a/docs/there.md").write_text("# There\n\n## Here\n")
    (tmp_path / "a/docs/lost.md").write_text("# In no tree\n")
    progress: list[str] = []
    with pytest.raises(BuildError) as told:
        run_sphinx(tmp_path / "a", tmp_path / "site", "off", lambda text, step: progress.append(text))
    assert any(line.startswith("reading sources") for line in progress)
    for words in (*FAULTS.values(), "docs/lost.md: WARNING: document isn't included in any toctree"):
        assert words in str(told.value)
    assert len(str(told.value).splitlines()) == len(FAULTS) + 1


def test_what_is_missing_is_named_with_what_installs_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("docs.site.__main__.NEEDED", ("numpy", "no_such_package"))
    with pytest.raises(BuildError, match=r"^not installed: no_such_package; they come with bash setup\.sh --test$"):
        build(tmp_path / "site", notebooks=False)


def test_progress_is_a_line_for_each_step_and_few_within_one(capsys: pytest.CaptureFixture[str]) -> None:
    tell = Progress()
    tell("one")
    for number in range(9):
        tell(f"part {number}", step=False)
    tell("two")
    assert capsys.readouterr().err == "progress: one\nprogress: two\n"


def test_a_folder_with_other_things_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(BuildError):
        build(tmp_path, notebooks=False)
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.second
def test_the_site_is_built_without_a_warning_and_without_a_broken_link(tmp_path: Path) -> None:
    """The command fails on any warning of Sphinx and on a broken link; tests/test_notebooks.py runs the notebooks."""
    for name in NEEDED:
        pytest.importorskip(name)
    done = invoke(app, "--out", tmp_path / "site", "--no-notebooks")
    assert done.exit_code == 0, done.stderr
    assert int(re.match(r"(\d+) pages: ", done.stdout)[1]) > 40
    assert (tmp_path / "site/searchindex.js").exists()


# --- what its pages may do --------------------------------------------------------------------------------
def test_a_page_of_the_site_may_do_what_it_is_made_of():
    head = '<head><meta charset="utf-8"><style>p {}</style></head>'
    text = f'<html>{head}<body><script>a()</script><script src="x.js"></script>'
    page = with_policy(text)
    content = re.search(r'charset="utf-8"><meta http-equiv="Content-Security-Policy" content="([^"]*)">', page)
    assert content is not None  # before all that it is for
    rules = {rule.split()[0]: rule.split()[1:] for rule in content[1].split(";")}
    assert rules["default-src"] == ["'none'"]
    assert rules["script-src"] == ["'self'", "file:", checksum("a()")]
    assert rules["style-src-elem"] == ["'self'", "file:", checksum("p {}")]
    assert not re.search(r"https?:|\*|unsafe-eval", content[1])
    for wrong, said in (
        ("<p onclick='x()'>", "onclick"),
        ('<img alt="" src="https://example.org/a.png">', r"loads https://example\.org/a\.png from the network"),
        ("<script src=//cdn.example.org/a.js></script>", r"loads //cdn\.example\.org/a\.js"),
        ('<link rel="stylesheet" href="https://example.org/a.css">', r"loads https://example\.org/a\.css"),
    ):
        with pytest.raises(ValueError, match=said):
            with_policy(f"<head></head>{wrong}")
    with_policy('<head></head><a href="https://example.org">x</a>')
