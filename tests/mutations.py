"""Mutation tests: each fault in `mutations.md` must make the tests in its row fail.

    python -m tests.mutations            # all rows of mutations.md
    python -m tests.mutations 3 14       # some of them

Each row of `mutations.md` has a file, a text that occurs once in the file, a replacement and tests.
The text is replaced in a copy of the checkout, and the tests run there. Kernels run without the
compiler. The same tests must pass without the replacement. The exit code is 1 if the tests pass
with a fault, or fail without it.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
TABLE = Path(__file__).with_name("mutations.md")
ROW = re.compile(r"^\| (\d+) \| `([^`]+)` \| `([^`]+)` \| `([^`]+)` \| `([^`]+)` \|$", re.MULTILINE)
COPIED = (
    *("cavmarl", "tests", "envs", "agents", "configs", "train", "benchmarks", "docs", "examples"),
    "pyproject.toml",
)
LIMIT_S = 1800.0  # time limit for the tests of a row
# Random numbers are products that overflow. Without the compiler, NumPy warns of the overflow.
WRAPS = "ignore:overflow encountered:RuntimeWarning"


class Mutation(NamedTuple):
    """A row of the table: with `new` instead of `old` in `file`, `tests` must fail."""

    number: int
    file: str
    old: str
    new: str
    tests: str


def read_table() -> list[Mutation]:
    return [Mutation(int(number), *rest) for number, *rest in ROW.findall(TABLE.read_text())]


def mutated(mutation: Mutation) -> str:
    """Return the text of the file with the mutation."""
    text = (ROOT / mutation.file).read_text()
    found = text.count(mutation.old)
    if found != 1:
        raise ValueError(f"row {mutation.number}: {mutation.old!r} is {found} times in the file")
    return text.replace(mutation.old, mutation.new)


def is_passed(tests: str, *, interpreted: bool, file: str = "", text: str = "") -> bool:
    """Return whether tests pass in a copy of the checkout, in which `file` has the given text."""
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        place = Path(folder) / "checkout"
        place.mkdir()
        for name in COPIED:
            source = ROOT / name
            if source.is_dir():
                shutil.copytree(source, place / name, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(source, place / name)
        if file:
            (place / file).write_text(text)
        maps = os.environ.get("CAVMARL_SHARED_MAPS", str(ROOT.parent / "shared" / "maps"))
        plain = {"NUMBA_DISABLE_JIT": "1"} if interpreted else {}
        words = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-W", WRAPS]
        done = subprocess.run(
            [*words, *tests.split()],
            cwd=place,
            env={**os.environ, **plain, "PYTHONPATH": str(place), "CAVMARL_SHARED_MAPS": maps},
            capture_output=True,
            text=True,
            timeout=LIMIT_S,
        )
        if done.returncode not in (0, 1):
            raise ValueError(f"{tests}: pytest ended with {done.stdout[-2000:]}")
        return done.returncode == 0


@cache
def passes_without(tests: str, *, interpreted: bool) -> bool:
    return is_passed(tests, interpreted=interpreted)


def verdict(mutation: Mutation) -> str:
    interpreted = any(folder in mutation.file for folder in ("/kernels/", "core/math/"))
    file, text = mutation.file, mutated(mutation)
    if is_passed(mutation.tests, interpreted=interpreted, file=file, text=text):
        return "MISSED"
    return "caught" if passes_without(mutation.tests, interpreted=interpreted) else "FAILS ANYWAY"


def main(chosen: list[str]) -> int:
    missed = 0
    for mutation in read_table():
        if chosen and str(mutation.number) not in chosen:
            continue
        found = verdict(mutation)
        missed += found != "caught"
        print(f"{mutation.number:3d} {found}  {mutation.file}", flush=True)
    return min(missed, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
