#!/usr/bin/env bash
# Makes .venv beside this file, installs the twin into it and checks that it works. Safe to run again: a second run does nothing
# but the check.
set -euo pipefail

usage() {
    cat <<'TEXT'
Usage: bash setup.sh [--test] [--help]

Makes a virtual environment in .venv, installs the space camera twin and what it needs into it, and checks that it works.
What is installed is pinned with checksums in docs/supply/lock; docs/installed.md says more.

  --test   also install what the tests need (pytest, ruff, mypy, the programs the twin is checked against, ray-optics among
           them in a folder of its own, .venv/peers), what builds the documentation (Sphinx) and what writes Parquet
  --help   this text

Needs Python 3.11 or newer with its venv module, and libatomic.so.1. As root on Debian or Ubuntu the last two are installed when
they are missing; an ordinary user reads which packages an administrator has to install.
Exit code: 0 installed and checked, 1 something failed, 2 bad option, or Python or a package of the system is missing.
The variable PYTHON names the interpreter to use, for instance PYTHON=python3.13.
TEXT
}

all="install runtime live test peers"
layers="install runtime live"
for argument in "$@"; do
    case "$argument" in
        --live) ;; # of earlier versions; what serves the live twin is always installed, 2.4 MB
        --test) layers="$all" ;;
        -h | --help) usage; exit 0 ;;
        *) echo "setup.sh: unknown option $argument" >&2; usage >&2; exit 2 ;;
    esac
done

cd "$(dirname "${BASH_SOURCE[0]}")"
say() { echo "setup: $*"; }
fail() { echo "setup: $*" >&2; exit 1; }
needs() { echo "setup: $*" >&2; exit 2; } # what no ordinary user can give

# --- Python -----------------------------------------------------------------------------------------------------------------
new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; }
python=""
for candidate in ${PYTHON:-python3 python3.13 python3.12 python3.11 python3.14}; do
    if command -v "$candidate" >/dev/null && new_enough "$candidate"; then
        python="$(command -v "$candidate")"
        break
    fi
done
[ -n "$python" ] || needs "no Python 3.11 or newer found (looked for: ${PYTHON:-python3, python3.11 .. python3.14}). Install it, or name it: PYTHON=/path/to/python3 bash setup.sh"
say "using $("$python" --version) at $python"

# --- what pip cannot install ------------------------------------------------------------------------------------------------
has_venv() { "$python" -c 'import venv, ensurepip' >/dev/null 2>&1; }
has_libatomic() { [ "$(uname -s)" != Linux ] || "$python" -c 'import ctypes; ctypes.CDLL("libatomic.so.1")' >/dev/null 2>&1; }
missing_packages() {
    has_venv || echo python3-venv
    has_libatomic || echo libatomic1
}
missing="$(missing_packages | xargs)"
if [ -n "$missing" ] && [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
    say "installing with apt: $missing"
    # The package lists of a fresh system are empty or old.
    apt-get update -qq || say "apt-get update failed; trying with the lists that are there"
    # shellcheck disable=SC2086
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing >/dev/null \
        || fail "apt could not install: $missing"
    missing="$(missing_packages | xargs)"
fi
[ -z "$missing" ] || needs "$missing missing; an administrator installs it with \"apt-get install $missing\" (Debian, Ubuntu), then run setup.sh again"

# --- .venv ------------------------------------------------------------------------------------------------------------------
if [ -e .venv ] && ! { new_enough .venv/bin/python && .venv/bin/python -m pip --version >/dev/null 2>&1; }; then
    say ".venv does not work; making it anew"
    rm -rf .venv
fi
if [ ! -e .venv ]; then
    say "making .venv"
    "$python" -m venv .venv
fi

# What is installed is decided by the lock files, pyproject.toml, the Python version and where this folder is; when none has
# changed, nothing is installed again. An installation for the tests serves everything else as well.
stamp=".venv/installed"
lock="docs/supply/lock"
state="$({ cat pyproject.toml "$lock"/*.txt; .venv/bin/python -VV; pwd; } | sha256sum | cut -d' ' -f1)"
if grep -qsxF -e "$state $layers" -e "$state $all" "$stamp"; then
    say "everything is installed already"
else
    say "installing (some minutes on a slow line)"
    rm -f "$stamp"
    # Only files whose checksum the lock has, and no package that would run a program of its own to be built: what a lock
    # file does not name is not installed, whoever asks for it. What is there already is not fetched again.
    locked() {
        .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-compile \
            --no-deps --require-hashes --only-binary :all: "$@" \
            || fail "pip could not install the packages of $lock; run this again to go on. (If it speaks of hashes: the package
       index sent another file than the one that was locked. Do not install that file; see docs/installed.md)"
    }
    # Byte code on all cores, for users who cannot write here; pip would make it on one. Files of packages that no Python can
    # compile, as templates are, are not imported either.
    compiled() { .venv/bin/python -m compileall -qq -j 0 "$@" >/dev/null 2>&1 || true; }
    # pip first and alone: it should not replace itself while it installs others
    locked -r "$lock/install.txt"
    locked -r "$lock/runtime.txt"
    compiled .venv/lib & # while the rest is fetched
    files=()
    for layer in $layers; do
        case "$layer" in install | runtime | peers) ;; *) files+=(-r "$lock/$layer.txt") ;; esac
    done
    [ ${#files[@]} = 0 ] || locked "${files[@]}"
    if [ "$layers" = "$all" ]; then
        # ray-optics would bring Qt; the tests find it where they look for it, and nothing else does
        rm -rf .venv/peers
        locked --target .venv/peers -r "$lock/peers.txt"
    fi
    # The project itself, by the setuptools that is there now, which warns of names that folders and packages share.
    PYTHONWARNINGS=ignore .venv/bin/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e . \
        || fail "pip could not install the project itself"
    wait
    [ "$layers" != "$all" ] || compiled .venv/lib .venv/peers
    echo "$state $layers" >"$stamp"
fi

say "checking"
.venv/bin/python -m twin.doctor --quick
say "done"
