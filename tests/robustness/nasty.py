"""What the mutators put in place of numbers, units, texts, values and paths."""

from __future__ import annotations

from typing import Any

# as many to a line as fit
# fmt: off
PATHS = (
    "../../x", "../../../../../../etc/passwd", "/etc/passwd", "/etc/shadow.yaml", "/dev/zero", "/dev/stdin",
    "/proc/self/mem", "/proc/self/environ", ".", "..", "/", "//", "./", "~/x.yaml", "~root/x.yaml", "$HOME/x.yaml",
    "a\x00b.yaml", "a\nb.yaml", "./a\nb.yaml", "x.yaml/y.yaml", "fifo.yaml", "loop.yaml", "folder.yaml",
    "binary.yaml", "nowhere.yaml", "C:\\x.yaml", "..\\..\\x", "http://localhost/x.yaml", "file:///etc/passwd",
    "n" * 300 + ".yaml", "./" + "d/" * 2000 + "x.yaml", "gf7/../gf7", "GF7", "gf7.yaml", "x;touch y", "$(touch y)",
    "`touch y`", "|touch y", "-rf", "--help", "*", "\ud7ff.yaml", "ｇｆ７", "con",
)
"""Names that lead astray; fuzz.py puts fifo.yaml, loop.yaml, folder.yaml and binary.yaml beside the file."""

NUMBERS = (
    "0", "-0.0", "1", "-1", "2", "0.5", "-1e-300", "5e-324", "1e300", "-1e308", "1e309", "1e-400", "1e999999",
    "999999999999999999999999999999", "9" * 400, "2147483648", "9223372036854775808", "-9223372036854775809", ".inf",
    "-.inf", ".nan", "nan", "inf", "Infinity", "1_000", "0x10", "0o17", "017", "0b1", "1:30", "1:30:00.5",
    "2020-01-01", "2020-01-01T00:00:00Z", "yes", "no", "on", "off", "y", "true", "false", "~", "null", "\"\"", "''",
    "1.", ".5", "+1", "1e", "e1", "--1", "1,5", "１", "١", "½", "²", "−1", "1 000", "1\xa0m", "%s", "{x}", "[red]x[/]",
    "[/]", "\\n", "\"\\u0000\"", "\"\\e[31m\"", "3.0", "1e2", "12.5", "65536", "100000000", "1e9",
)
UNITS = (
    "m", "mm", "um", "nm", "km", "µm", "μm", "Å", "deg", "arcsec", "arcmin", "rad", "mrad", "s", "ms", "min", "h",
    "Hz", "K", "mK", "degC", "°C", "degF", "delta_degC", "percent", "%", "ppm", "dB", "px", "pixel", "kg", "W", "lm",
    "1/m", "1/m^3", "m/s", "m**2", "m^-1", "m m", "m*m", "m/0", "m**9999999", "m**1e9", "m**m**m", "9**9**9 m", "(m)",
    "((((m))))", "furlong", "light_year", "parsec", "planck_length", "count", "fluid_ounce", "M", "S", "Deg", "", " ",
    "m s K", "__import__('os')", "m;", "m#", "m,", "1 m", "-m", "sqrt(m)", "m" * 500, "m*" * 200 + "m", "😀", "ｍ",
    "m\u200b",
)
TEXTS = (
    "", " ", "x" * 70, "x" * 3000, "a b", "ü µm", "😀", "\u202e", "\u2028", "\x85", "\x7f", "\x1b[31m", "a\tb", "a\nb",
    "\r", "<script>alert(1)</script>", "&amp;", "{{ 7 * 7 }}", "{% x %}", "%(x)s", "[bold]x", "[/red]", "\\", "'",
    "\"", "null", "1", "true", "1e3", "*", "&x", "!x", "- x", "a: b", "#", "?", "|", ">", "@", "`", "__class__",
    "__init__", "model_config", "_source", "copy", "self", "base", "base/", "/base", "base//forward",
    "base/forward/M1/x", "Z0", "Z-1", "Z1", "Z99999999", "A4", "A3", "A999999999", "forward", "backward", "nadir",
    "gf7", "P", "M1", "\ufeff", "\ud7ff", "İ", "ß", "Ǆ",
)
VALUES: tuple[Any, ...] = (
    None, True, False, 0, 1, -1, 2, 3, 17, 1000000, 1000000000, 1000000000000000000, 9223372036854775808,
    100000000000000000000000000000, 0.0, -0.5, 1.5, 1e+300, 1e-300, 5e-324, float("inf"), float("-inf"), float("nan"),
    [], {}, [[]], [{}], {"": None}, [None], ["x"], {"x": 1}, {"x": {"y": {}}}, "0 m", "1 m", "-1 m", "1e308 m",
    "1 nm", "1e6 km", "0 deg", "90 deg", "-90 deg", "180 deg", "1e9 deg", "0 s", "-1 s", "1e-12 s", "1e6 h", "0 K",
    "-300 K", "1e9 K", "0 percent", "100 percent", "1e6 percent", "1 1/m^3", "1e-30 m", "0 1/m",
)
TAGS = (
    "!!python/object/apply:os.system ", "!!python/name:os.system ", "!!python/object:scenes.specs.job.JobSpec ", "!x ",
    "! ", "!!float ", "!!set ", "!!omap ", "!!binary ", "!!timestamp ", "!<tag:yaml.org,2002:str> ", "!<> ", "!%zz ",
    "!!",
)
BLOCKS = tuple(f"{style}\n{' ' * n}" for style in ("|", ">", "|-", ">+", "|2", "|9", ">0", "|x") for n in (2, 8, 30))
MERGES = ("{}\n<<: {a: 1}\n", "{}\n<<: *x\n", "{}\n'<<': {a: 1}\n", "{}\nx:\n  <<: [{a: 1}]\n")
DOCUMENTS = ("{}\n---\n{}", "---\n{}", "{}\n...\n", "{}\n...\nx: 1\n", "--- \n---\n", "...", "")
DIRECTIVES = (
    "%YAML 1.1\n---\n{}", "%YAML 9.9\n---\n{}", "%TAG ! x:\n---\n{}", "%FOO bar\n---\n{}", "%YAML 1.2\n{}", "%{}",
    "%YAML 1.1\n%YAML 1.1\n---\n{}",
)
NOTHING = ("# nothing\n", "\n\n", "~\n", "''\n", "3\n", "text\n", "[]\n", "- 1\n", "? \n", "null: null\n", ".nan\n")
KEYS = (
    "? [1, 2]\n: 3\n", "? {a: b}\n: 3\n", "? |\n  a\n  b\n: 3\n", "1: 2\n", "true: 2\n", "~: 2\n", "'': 2\n", "? x\n",
    "[a]: 1\n", ": 1\n",
)
WORDS = (
    "1e400", "-1e308", "nan", "0", "1e-320", "S" * 300, "\u202e", "&", "!", ";", "'", '"', "INFINITY", "SURF 1",
    "SI 0 0",
)
"""In place of words and lines of other programs' files."""
MARKS = (b"\0", b"\t", b"\r", b"\x85", b"\xff\xfe", b"\xed\xa0\x80", b"\xc0\x80", b"\xf4\x90\x80\x80")
LINE_ENDS = (b"\r\n", b"\r", b"\n\n", b"\n\r", b"\xe2\x80\xa8", b"", b"\n \n", b"\n\t")
# fmt: on
