"""Record again all files that a change of behaviour makes stale: `make record`, or one part.

    python -m tests.record [golden|zoo|scores|blocks [NAME ...]] [--processes N]

Without a part, all four are recorded, in this order:

golden: hashes of the results of worlds (tests.golden.worlds); names are rows.
zoo: results of the zoo and the board (tests.golden.zoo); names are drivers.
scores: tables of scores on pages (tests.record.score_tables); names are pages, or blocks as
    PAGE:BLOCK.
blocks: blocks of pages that tests generate from the code; names are tests, as for pytest.

Each part prints the changed files and its duration. The first part that fails ends the recording.
Each file is replaced as a whole, so an interrupted recording leaves no incomplete files.
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence

from cavmarl.core.errors import CavmarlError
from tests.record.jobs import ROOT, finish_all, is_kept, results_folder
from tests.record.score_tables import TABLES, Results, ScoreTable
from tests.support.generated import write_block

RECORDED = (
    "*.md",
    "docs/**/*.md",
    "envs/**/*.md",
    "agents/**/*",
    "board/**/*",
    "tests/golden/*.json",
)
OF_INSTALLATION = "tests/test_licences.py"  # its table depends on the installation


class RecordError(CavmarlError):
    """Raised if a part cannot be recorded."""


def golden(names: Sequence[str], given: argparse.Namespace) -> None:
    """Record the golden rows."""
    _run("-m", "tests.golden.worlds", *names)


def zoo(names: Sequence[str], given: argparse.Namespace) -> None:
    """Record the results of drivers."""
    _run("-m", "tests.golden.zoo", *names)


def scores(names: Sequence[str], given: argparse.Namespace) -> None:
    """Evaluate, and write the tables of scores."""
    tables = tables_named(names)
    jobs = [job for table in tables for job in table.jobs]
    results = Results(finish_all(jobs, given.processes, _tell, results_folder()))
    texts = [table.write(results) for table in tables]
    for table, text in zip(tables, texts, strict=True):
        write_block(ROOT / table.page, table.block, text)


def blocks(names: Sequence[str], given: argparse.Namespace) -> None:
    """Run the tests that compare blocks in the mode in which they write the blocks."""
    tests = list(names) or block_tests()
    _run("-m", "pytest", "-q", "-n", "0", *tests, CAVMARL_REWRITE="1")


PARTS: dict[str, Callable[[Sequence[str], argparse.Namespace], None]] = {
    "golden": golden, "zoo": zoo, "scores": scores, "blocks": blocks,
}  # fmt: skip


def block_tests() -> list[str]:
    """Return the tests that compare blocks of pages with the code, as FILE::TEST.

    Other tests in the same files are left out: they may write golden files of formats, which do not
    depend on behaviour.
    """
    found = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        text = path.read_text("utf-8")
        name = path.relative_to(ROOT).as_posix()
        if "check_block(" in text and name != OF_INSTALLATION:
            functions = (node for node in ast.parse(text).body if isinstance(node, ast.FunctionDef))
            found += [
                f"{name}::{node.name}"
                for node in functions
                if "check_block(" in (ast.get_source_segment(text, node) or "")
            ]
    return found


def tables_named(names: Sequence[str]) -> list[ScoreTable]:
    """Return the tables of the named pages or blocks, or all tables if there are no names."""
    unknown = [name for name in names if not any(name in (t.page, t.name) for t in TABLES)]
    if unknown:
        known = "\n  ".join(table.name for table in TABLES)
        raise RecordError(f"{unknown[0]}: no page with scores and no block; there are\n  {known}")
    return [table for table in TABLES if not names or {table.page, table.name} & set(names)]


def record(part: str, names: Sequence[str], given: argparse.Namespace) -> None:
    """Record one part; print the changed files and the duration."""
    print(f"{part} …", flush=True)
    before, began_s = _hashes(), time.monotonic()
    try:
        PARTS[part](names, given)
    finally:
        after = _hashes()
        changed = sorted(p for p in before | after if before.get(p) != after.get(p))
        print(f"{part}: {time.monotonic() - began_s:.0f} s, {len(changed)} files changed")
        print("".join(f"  {path}\n" for path in changed), end="", flush=True)


def main() -> int:
    """Record the parts of the command line; return 1 if a part fails."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.record",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("part", nargs="?", choices=PARTS, help="default: all parts")
    parser.add_argument("names", nargs="*", metavar="NAME", help="default: everything of the part")
    parser.add_argument(
        "--processes",
        type=int,
        default=len(os.sched_getaffinity(0)),
        help="scores: jobs at a time [default: one for each core]",
    )
    given = parser.parse_args()
    try:
        for part in [given.part] if given.part else PARTS:
            record(part, given.names, given)
    except CavmarlError as error:
        print(f"stopped: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("stopped: interrupted; finished scores are kept", file=sys.stderr)
        return 130
    return 0


def _run(*words: str, **environment: str) -> None:
    """Run a Python program in the repository.

    Raises RecordError if the program fails; its output has the reason.
    """
    command = [sys.executable, *words]
    if code := subprocess.run(command, cwd=ROOT, env=os.environ | environment).returncode:
        said = f"python {' '.join(words)}"
        raise RecordError(f"`{said}` ended with exit code {code}; the reason is above")


def _hashes() -> dict[str, str]:
    """Return the hash of each file that a recording can change, by path."""
    files = {path for pattern in RECORDED for path in ROOT.glob(pattern)}
    return {
        path.relative_to(ROOT).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in files
        if is_kept(path)
    }


def _tell(line: str) -> None:
    print(line, flush=True)


if __name__ == "__main__":
    sys.exit(main())
