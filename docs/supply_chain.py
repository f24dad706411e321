"""List the dependencies of cavmarl: exact files with hashes, and licences.

python -m docs.supply_chain lock       # writes constraints/hashes.txt, by pip's own resolver
python -m docs.supply_chain licences   # prints the table of docs/reference/licences.md
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
# Wheels of torch depend on the processor.
LOCKED = "compile,sumo,maps,nodes,report,render,record,followers,service"
EXTRAS = (
    "",
    "compile",
    "sumo",
    "maps",
    "nodes",
    "report",
    "render",
    "record",
    "followers",
    "viewer",
    "service",
    "train",
    "torchrl",
    "ray",
    "mpi",
)
HEAD = """\
# Every file that `pip install '.[{extras}]'` takes on 64-bit Linux with Python
# 3.11, with its hash; made by `make lock`. To install nothing else:
#     pip install --require-hashes --requirement constraints/hashes.txt
#     pip install --no-deps --no-build-isolation .
"""


def write_lock(path: Path) -> None:
    """Resolve and download dependencies with pip, and write the hash of each file."""
    words = [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", "--quiet"]
    words += ["--report", "-", f".[{LOCKED}]", "--constraint", "constraints/exact.txt"]
    done = subprocess.run(words, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    lines = []
    for found in json.loads(done.stdout)["install"]:
        name, version = found["metadata"]["name"], found["metadata"]["version"]
        if name != "cavmarl":
            digest = found["download_info"]["archive_info"]["hashes"]["sha256"]
            lines.append(f"{canonicalize_name(name)}=={version} --hash=sha256:{digest}\n")
    path.write_text(HEAD.format(extras=LOCKED) + "".join(sorted(lines)), encoding="utf-8")


def licences() -> Iterator[tuple[str, str, str]]:
    """Return (package, what needs it, licence) of all packages of an installation.

    Packages that are not installed here are left out.
    """
    needed: dict[str, list[str]] = defaultdict(list)
    for extra in EXTRAS:
        for name in sorted(_closure("cavmarl", extra)):
            if not needed[name] or needed[name] != ["cavmarl"]:
                needed[name].append(extra or "cavmarl")
    for name, extras in sorted(needed.items()):
        yield name, ", ".join(extras), _licence(name)


def _closure(name: str, extra: str, seen: set[tuple[str, str]] | None = None) -> set[str]:
    """Return all packages that a package with an extra needs."""
    seen = set() if seen is None else seen
    found: set[str] = set()
    for line in _requirements(name, extra):
        need = Requirement(line)
        if need.marker is not None and not need.marker.evaluate({"extra": extra}):
            continue
        other = canonicalize_name(need.name)
        for inner in ("", *need.extras):
            if (other, inner) in seen:
                continue
            seen.add((other, inner))
            try:
                found |= _closure(other, inner, seen) | {other}
            except PackageNotFoundError:
                continue
    return found - {"cavmarl"}


def _requirements(name: str, extra: str) -> list[str]:
    """Return the requirements of a package; those of cavmarl are read from this checkout."""
    if name != "cavmarl":
        return distribution(name).requires or []
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    needs: list[str] = [*project["dependencies"]]
    return needs + (project["optional-dependencies"][extra] if extra else [])


def _licence(name: str) -> str:
    told = distribution(name).metadata
    if expression := told.get("License-Expression"):
        return str(expression)
    classes = [c.rsplit(" :: ", 1)[-1] for c in told.get_all("Classifier") or [] if "License" in c]
    short = (told.get("License") or "").split("\n", 1)[0].strip()
    if classes and classes != ["OSI Approved"]:
        return ", ".join(re.sub(r" \(.*\)$", "", name) for name in classes)
    return short or "see its files"


if __name__ == "__main__":
    if sys.argv[1:] == ["lock"]:
        write_lock(ROOT / "constraints/hashes.txt")
    elif sys.argv[1:] == ["licences"]:
        for row in licences():
            print("| {} |".format(" | ".join(row)))
    else:
        sys.exit(__doc__)
