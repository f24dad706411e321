"""List the benchmarks, or run one: `python -m benchmarks [NAME [OPTIONS]]`."""

from __future__ import annotations

import ast
import runpy
import sys
from pathlib import Path

from cavmarl.cli import main as cavmarl

KEPT = {
    "step": "Agent-steps per second compared with highway-env.",
    "signals": "Decisions of max pressure per second compared with sumo-rl.",
    "traffic": "Traffic compared with SUMO's own run of the same demand.",
    "train": "End-to-end PPO compared with stable-baselines3.",
}


def programs() -> dict[str, str]:
    """Return the description of each program by name, without modules that are not programs."""
    found = {}
    for path in sorted(Path(__file__).parent.glob("*.py")):
        text = path.read_text(encoding="utf-8")
        if "\n    run(measure)\n" in text:
            found[path.stem] = (ast.get_docstring(ast.parse(text)) or "").splitlines()[0]
    return found


def main(words: list[str]) -> None:
    """List the benchmarks, or run the benchmark named by the first word with the other words."""
    name, *options = words or [""]
    if name in KEPT:
        cavmarl(["bench", name, *options])
    elif name in programs():
        sys.argv = [f"benchmarks.{name}", *options]
        runpy.run_module(f"benchmarks.{name}", run_name="__main__", alter_sys=True)
    elif name in ("", "-h", "--help"):
        print("make bench NAME=… ARGS='…'")
        for known, measured in (KEPT | programs()).items():
            print(f"  {known:14} {measured}")
    else:
        sys.exit(f"no benchmark '{name}': python -m benchmarks lists them")


if __name__ == "__main__":
    main(sys.argv[1:])
