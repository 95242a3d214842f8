"""Every reader of a file that a user names refuses the same with the same words, and says which kind it wanted."""

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from scenes.lens.batoid_reader import read_batoid
from scenes.lens.codev_reader import read_codev
from scenes.lens.glass_catalogue import read_catalogue
from scenes.lens.zemax_reader import read_zemax
from scenes.specs.resolved import resolve
from scenes.yaml.csv_table import table_text
from scenes.yaml.errors import InputError
from scenes.yaml.finish_files import read_bsdf
from scenes.yaml.input_file import read_bytes, read_text
from scenes.yaml.yaml_file import read_yaml

READERS: dict[str, tuple[str, str, Callable[[Path], object], str]] = {
    "zemax": ("a.zmx", "a prescription", read_zemax, "at most 16 MB"),
    "codev": ("a.seq", "a prescription", read_codev, "at most 16 MB"),
    "batoid": ("a.yaml", "a telescope in YAML", lambda path: read_batoid(path, 500e-9), "at most 100 kB"),
    "glasses": ("a.agf", "a glass catalogue", read_catalogue, "at most 16 MB"),
    "yaml": ("a.yaml", "a YAML file", read_yaml, "at most 1 MB"),
    "bsdf": ("a.bsdf", "a BSDF file", read_bsdf, "at most 67 MB"),
    "csv": ("a.csv", "a CSV file", table_text, "at most 1 GB"),
}
"""Name of a file, what it should be, what reads it, how long it may be."""


def refused(read: Callable[[Path], object], path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        read(path)
    return caught.value


@pytest.mark.parametrize("kind", READERS)
def test_what_is_no_file(kind: str, tmp_path: Path) -> None:
    name, what, read, _ = READERS[kind]
    (tmp_path / f"x{name}").touch()
    missing = refused(read, tmp_path / name)
    assert "no such file" in str(missing)
    assert missing.suggestion == str(tmp_path / f"x{name}")
    (tmp_path / name).mkdir()
    assert f"is a directory, not a regular file; allowed: {what}" in str(refused(read, tmp_path / name))
    assert f"is a device, not a regular file; allowed: {what}" in str(refused(read, Path("/dev/zero")))
    os.mkfifo(tmp_path / f"p{name}")  # to open it would block
    assert f"is a pipe, not a regular file; allowed: {what}" in str(refused(read, tmp_path / f"p{name}"))
    assert "Not a directory" in str(refused(read, tmp_path / f"x{name}" / name))
    assert "cannot be read" in str(refused(read, tmp_path / "\0"))


NAMED = {
    "instrument": "instrument: {}.yaml",
    "course.table": "instrument: gf7_pair\ncourse: {{table: {}}}",
    "perturb.base/forward/M2.deformation.table": "instrument: gf7_pair\n"
    "perturb: {{base/forward/M2: {{deformation: {{table: {}}}}}}}",
}
"""Key of a job -> a job that names a file there."""


@pytest.mark.parametrize("kind", ["a device", "a pipe", "a directory"])
def test_what_a_file_names_is_no_file(kind: str, tmp_path: Path) -> None:
    """It is said what stands there, at the key, and nothing of it is read."""
    place = tmp_path / "what.yaml"
    make = {"a device": lambda: place.symlink_to("/dev/zero"), "a pipe": lambda: os.mkfifo(place)}
    make.get(kind, place.mkdir)()
    for key, text in NAMED.items():
        job = tmp_path / "job.yaml"
        job.write_text(text.format(place.with_suffix("") if ".yaml" in text else place), "utf-8")
        error = refused(resolve, job)
        assert f"{place} is {kind}, not a regular file" in str(error)
        assert ".".join(map(str, error.key)) == key


@pytest.mark.parametrize("kind", [kind for kind in READERS if kind != "csv"])
def test_what_is_too_large(kind: str, tmp_path: Path) -> None:
    """The file is sparse, and read no farther than it may be long."""
    name, _, read, most = READERS[kind]
    with (tmp_path / name).open("wb") as file:
        file.truncate(1 << 40)
    assert f"{tmp_path / name}: too large; allowed: {most}" in str(refused(read, tmp_path / name))


@pytest.mark.parametrize(("most", "size"), [(999, "999 bytes"), (1000, "1 kB"), (25_000, "25 kB")])
def test_as_much_as_is_allowed_is_read(most: int, size: str, tmp_path: Path) -> None:
    path = tmp_path / "file.txt"
    path.write_bytes(b"x" * most)
    assert read_bytes(path, "text", most, ()) == b"x" * most
    assert read_text(path, "text", most, ()) == "x" * most
    path.write_bytes(b"x" * (most + 1))
    assert f"at most {size}" in str(refused(lambda place: read_bytes(place, "text", most, ()), path))
