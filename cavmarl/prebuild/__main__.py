"""`python -m cavmarl.prebuild`: compile the kernels of the package, and maintain their list.

compile         compile the kernels for the first step of simple environments (`PLAIN_WORLDS`) into
                this machine's cache; --all: all kernels
build FOLDER    compile all kernels for the wheel's processor, and link them into a library
record FOLDER   add the calls in FOLDER, recorded by programs with `CAVMARL_KERNEL_CALLS=FOLDER`, to
                the list of kernels, and remove calls that have become impossible
check FOLDER    exit with 1 if a call in FOLDER, or a kernel called from Python, is not in the list
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from cavmarl.core.cache_folder import cache_dir
from cavmarl.core.compiled.signatures import CALLS_SETTING
from cavmarl.core.errors import KernelError
from cavmarl.prebuild.call_list import (
    KernelCall,
    can_be_made,
    marked,
    merged,
    read_manifest,
    recorded_calls,
    write_manifest,
)
from cavmarl.prebuild.kernel_list import called_kernels

PLAIN_WORLDS = ("ring", "merge", "grid4x4")


def build(folder: Path, processes: int) -> None:
    """Compile each call of the list for the wheel's processor, and link the library."""
    from cavmarl.prebuild.linking import FEATURES, PROCESSOR, link

    # Numba reads these variables on import, in this process and in the compiling processes.
    os.environ["NUMBA_CPU_NAME"] = PROCESSOR
    os.environ["NUMBA_CPU_FEATURES"] = FEATURES
    from cavmarl.prebuild.compile_calls import compile_into_cache, kernel_file, usable_processes

    started = time.monotonic()
    calls = read_manifest()
    if missing := called_kernels() - {call.name for call in calls}:
        raise KernelError(
            f"the list of kernels lacks {', '.join(sorted(missing))}: run `make test`, then "
            "`make kernels`"
        )
    count = compile_into_cache(calls, processes or usable_processes())
    found = [kernel_file(call).load() for call in calls]
    if None in found:
        raise KernelError(f"{cache_dir()} does not store compiled kernels: set CAVMARL_CACHE_DIR")
    # Code for arrays of any layout also serves calls with contiguous arrays.
    kernels = list({kernel.symbol: kernel for kernel in found if kernel is not None}.values())
    link(kernels, folder)
    size = sum(path.stat().st_size for path in folder.iterdir()) / 1e6
    print(
        f"cavmarl: {len(kernels)} kernels for {PROCESSOR}, {count} of them compiled now, in "
        f"{time.monotonic() - started:.0f} s: {size:.1f} MB in {folder}"
    )


def compile_here(processes: int, is_all: bool) -> None:
    """Compile kernels for this machine into the cache."""
    from cavmarl.prebuild.compile_calls import compile_into_cache, usable_processes

    calls = [call for call in read_manifest() if call.is_plain or is_all]
    compile_into_cache(calls, processes or usable_processes())


def record(folder: Path) -> None:
    """Update the list: add recorded calls, and remove calls that have become impossible."""
    known = called_kernels()
    plain = _calls_of_plain_worlds()
    found = {*recorded_calls(folder), *plain, *filter(can_be_made, read_manifest())}
    calls = merged(marked((call for call in found if call.name in known), plain))
    write_manifest(calls)
    print(f"{len(calls)} calls of {len({call.name for call in calls})} kernels")
    if missing := known - {call.name for call in calls}:
        print(f"never called: {', '.join(sorted(missing))}")


_PLAIN_WORLD = """
import sys, cavmarl
env = cavmarl.parallel_env(sys.argv[1])
observations, _ = env.reset(seed=0)
env.step({agent: env.action_space(agent).sample() for agent in env.agents})
"""


def _calls_of_plain_worlds() -> set[KernelCall]:
    """Return the calls in the first step of `PLAIN_WORLDS`, with a new and a cached map."""
    with TemporaryDirectory() as folder:
        calls, cache = Path(folder, "calls"), Path(folder, "cache")
        calls.mkdir()
        kernels = cache_dir() / "kernels"
        kernels.mkdir(parents=True, exist_ok=True)
        cache.mkdir()
        (cache / "kernels").symlink_to(kernels)
        environment = {**os.environ, CALLS_SETTING: str(calls), "CAVMARL_CACHE_DIR": str(cache)}
        for name in (*PLAIN_WORLDS, *PLAIN_WORLDS):
            command = [sys.executable, "-c", _PLAIN_WORLD, name]
            subprocess.run(command, env=environment, check=True)
        return recorded_calls(calls)


def check(folder: Path) -> int:
    """Report recorded calls and kernels that are not in the list; return the exit code."""
    calls = marked(read_manifest(), set())
    # A call that the list covers does not change the merged list.
    unknown = {call.name for call in merged(calls | recorded_calls(folder)) - calls}
    unknown |= called_kernels() - {call.name for call in calls}
    for name in sorted(unknown):
        print(f"not in the list of kernels, or with other types: {name}")
    if unknown:
        print(f"run `python -m cavmarl.prebuild record {folder}`, and commit the list")
    return int(bool(unknown))


def main() -> int:
    """Run one of the commands."""
    parser = argparse.ArgumentParser(
        prog="python -m cavmarl.prebuild",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=("compile", "build", "record", "check"))
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--all", action="store_true", help="compile all kernels in the list")
    parser.add_argument(
        "--processes",
        type=int,
        default=0,
        help="number of processes; 0: two, or one on a single core",
    )
    given = parser.parse_args()
    try:
        if given.command == "compile":
            compile_here(given.processes, given.all)
        elif given.folder is None:
            parser.error(f"{given.command} needs a FOLDER")
        elif given.command == "build":
            build(given.folder, given.processes)
        elif given.command == "record":
            record(given.folder)
        else:
            return check(given.folder)
    except KernelError as error:
        print(f"cavmarl: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
