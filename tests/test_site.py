"""The documentation's site: the reference leaves nothing out, its examples are right, and its links lead somewhere."""

import inspect
import json
import re
from pathlib import Path

import pytest

import twin
from docs.site.api_page import api_page
from docs.site.build import NEEDED, BuildError, build
from docs.site.command_pages import command_page, commands, programs
from docs.site.file_pages import READ_BY, file_pages
from docs.site.link_check import faults
from docs.site.markdown import slug
from docs.site.node_pages import ACTIONS, node_table
from docs.site.policy import with_policy
from docs.site.spec_examples import accepted, examples, kinds_of, shipped
from docs.site.spec_keys import flow
from scenes.schema import MODELS, json_schema
from scenes.yaml.yaml_file import parse_yaml
from tests.twin.study_bench import REFUSED
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
def test_every_example_is_taken_by_its_model() -> None:
    """As it is shown: the line is read as YAML and put into the mapping that it is an example in."""
    for kind in MODELS:
        for (model, name), example in examples(kind).items():
            data = parse_yaml(example.text).data
            assert list(data) == [name]
            assert accepted(model, {**example.mapping, **data}), example.text
            assert not accepted(model, {**example.mapping, "no_such_key": 1})
    (model, _), example = next((key, one) for key, one in examples("job").items() if key[1] == "frames")
    assert not accepted(model, {**example.mapping, "frames": 0})
    assert not accepted(model, {**example.mapping, "frames": "9 s"})


def test_a_value_in_one_line_of_yaml_reads_back() -> None:
    texts = ["2 um", "name", "a: b", "# no comment", "null", "true", "1.5", "", "-", "[x", "it's"]
    for value in (*texts, 7, 0.1, True, ["a, b", {"k": "v: w"}]):
        assert parse_yaml(f"x: {flow(value)}\n").data == {"x": value}


@pytest.mark.second
def test_every_sort_of_file_says_what_reads_it_and_ships_an_example(pages: dict[str, str]) -> None:
    assert set(READ_BY) == set(MODELS)
    assert all(shipped().values())
    words = " ".join(READ_BY.values())
    for line in re.findall(r"python -m ([\w.]+(?: [a-z]+)?)", words):
        assert line.split(" ")[0] in programs()
        assert line in commands(line.split(" ")[0]) or line.split(" ")[0] == line
    for kind, files in shipped().items():
        for file in files:
            assert kinds_of(file) == (kind,)
            assert file.read_text("utf-8").rstrip() in pages[f"reference/files/{kind}.md"]


# --- nodes, commands, library ----------------------------------------------------------------------------


def test_every_node_stands_in_the_reference(gf7_pair) -> None:
    table = node_table("gf7_pair", gf7_pair.nodes)
    for path, info in gf7_pair.nodes.items():
        row = next(line for line in table.splitlines() if f"`{path}`" in line)
        cells = [cell.strip() for cell in row.split("|")[1:-1]]
        assert {action for action, mark in zip(ACTIONS, cells[1:-1], strict=True) if mark} == set(info.allows)
        assert set(re.findall(r"`(\w+)`", cells[-1])) == {"origin", *info.pivots}


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
    page = api_page()
    for name in twin.__all__:
        assert f"## `twin.{name}`" in page
        thing = getattr(twin, name)
        assert inspect.getdoc(thing)
        if inspect.isclass(thing):
            public = [member for key, member in vars(thing).items() if not key.startswith("_")]
            assert all(inspect.getdoc(member) for member in public)


# --- the site --------------------------------------------------------------------------------------------


def write_site(folder: Path, **pages: str) -> Path:
    for name, text in pages.items():
        (folder / f"{name}.html").write_text(f"<html><body>{text}</body></html>")
    return folder


@pytest.mark.parametrize(("page", "said"), REFUSED["sites"])
def test_a_broken_site_is_found(page: str, said: str | None, tmp_path: Path) -> None:
    found = faults(write_site(tmp_path, index=page, other='<p id="here"></p>'))
    assert (said is None and found == []) or any(said in line for line in found if said)


def test_a_folder_with_other_things_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(BuildError):
        build(tmp_path, notebooks=False)
    assert (tmp_path / "thesis.tex").exists()


@pytest.mark.second
def test_the_site_is_built_without_a_warning_and_without_a_broken_link(tmp_path: Path) -> None:
    """`build` fails on any warning of Sphinx and on any fault of a link; tests/test_notebooks.py runs the notebooks."""
    for name in NEEDED:
        pytest.importorskip(name)
    assert build(tmp_path / "site", notebooks=False) > 40
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
    with pytest.raises(ValueError, match="onclick"):
        with_policy("<head></head><p onclick='x()'>")
