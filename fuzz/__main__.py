"""`python -m fuzz TARGET SECONDS`: fuzz one parser, guided by code coverage.

Inputs that reach new code are kept in `fuzz/corpus/TARGET`. An input that crashes, hangs or takes
too much memory is kept in `fuzz/crashes`, and the exit code is at least 1.
"""

from __future__ import annotations

import random
import sys
from pathlib import Path

import atheris

HERE = Path(__file__).resolve().parent
PACKAGE = HERE.parent / "cavmarl"
KERNELS = [path for folder in PACKAGE.rglob("kernels") for path in folder.rglob("*.py")]

# Kernels are not instrumented, because Numba compiles the bytecode of their functions.
with atheris.instrument_imports(
    include=["cavmarl", "sumolib", "yaml"],
    exclude=[".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts) for path in KERNELS],
):
    import cavmarl.roads.sumo_net.sumo_xml  # noqa: F401 - the reader imports it late
    from fuzz.targets import TARGETS

from fuzz.mutations import mutated  # noqa: E402

MAX_BYTES = 1 << 15
INPUT_S = 30
MEMORY_MB = 3000


def _mutate(content: bytes, limit: int, seed: int) -> bytes:
    """Change an input: half of the changes keep pieces of a file whole; libFuzzer makes others."""
    rng = random.Random(seed)
    if content and rng.random() < 0.5:
        return mutated(content, rng)[:limit]
    changed: bytes = atheris.Mutate(content, limit)
    return changed


def main(name: str, seconds: int) -> None:
    """Fuzz the target `name` for a number of seconds."""
    target = TARGETS[name]
    corpus, crashes = HERE / "corpus" / name, HERE / "crashes"
    corpus.mkdir(parents=True, exist_ok=True)
    crashes.mkdir(exist_ok=True)
    for k, content in enumerate(target.seeds()):
        (corpus / f"seed-{k}").write_bytes(content)
    options = {
        "max_total_time": seconds,
        "max_len": MAX_BYTES,
        "timeout": INPUT_S,
        "rss_limit_mb": MEMORY_MB,
        "artifact_prefix": f"{crashes}/{name}-",
        "print_final_stats": 1,
    }
    words = [f"-{key}={value}" for key, value in options.items()]

    def attack(content: bytes) -> None:
        target.accepts(content)

    atheris.Setup(["fuzz", *words, str(corpus)], attack, custom_mutator=_mutate)
    atheris.Fuzz()


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]))
