"""Golden rows and trained drivers on other processors, as far as this machine can imitate them.

    python -m tests.golden.portability [--quick|--emulated]

This command runs the rows of `worlds.py` and episodes of some trained drivers: first without
settings, then with each setting of `PROCESSORS`. Each run reads the maps again. The command prints
a line for each run. If the results of a run differ from those of the first run, the exit code is 1.
The command does not use the recorded hashes. `--quick` leaves out runs of more than a minute.
`--emulated` runs one step on processors that `qemu-x86_64` emulates, and on the processor for which
their kernels are compiled.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from numpy._core import _multiarray_umath as numpy_core

from cavmarl.core.cache_folder import cache_dir
from cavmarl.evaluate.provenance.manifest import hash_of_file, read_closed
from cavmarl.evaluate.zoo import RESULT_FOLDER, TABLES, entry_job
from cavmarl.policies.loading import policy_files
from tests.golden import worlds


def _numpy_without(*names: str) -> dict[str, str]:
    """Return the setting that switches off the processor features that NumPy uses here."""
    used = [name for name in numpy_core.__cpu_dispatch__ if numpy_core.__cpu_features__[name]]
    return {_NUMPY: " ".join(name for name in used if name.startswith(names))}


_NUMPY = "NPY_DISABLE_CPU_FEATURES"
_AVX512 = ("AVX512", "X86_V4")
_AVX2 = (*_AVX512, "AVX2", "FMA3", "X86_V3")
_KERNELS = {
    "CAVMARL_KERNELS": "native",
    "NUMBA_CPU_FEATURES": "",
}  # kernels use only features of the named CPU
_OLD_LIBRARIES = {
    **_numpy_without(*_AVX2),
    "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-FMA,-AVX2,-AVX512F",
    "OPENBLAS_CORETYPE": "Nehalem",
    "ATEN_CPU_CAPABILITY": "default",
}
_QEMU = "qemu-x86_64"


class Processor(NamedTuple):
    """A processor that this machine can imitate.

    Attributes:
        settings: environment variables for the imitation.
        is_quick: whether the run needs no compilation of kernels.
        emulated: name of the processor for `qemu-x86_64`, or empty without emulation.
    """

    settings: Mapping[str, str]
    is_quick: bool = False
    emulated: str = ""


PROCESSORS = {
    "NumPy without AVX-512": Processor(_numpy_without(*_AVX512), is_quick=True),
    "NumPy without AVX2": Processor(_numpy_without(*_AVX2)),
    "glibc without FMA": Processor(
        {"GLIBC_TUNABLES": _OLD_LIBRARIES["GLIBC_TUNABLES"]}, is_quick=True
    ),
    "BLAS and torch without AVX": Processor(
        {name: _OLD_LIBRARIES[name] for name in ("OPENBLAS_CORETYPE", "ATEN_CPU_CAPABILITY")}
    ),
    "kernels for Haswell": Processor({**_KERNELS, "NUMBA_CPU_NAME": "haswell"}),
    "all for Nehalem": Processor({**_KERNELS, "NUMBA_CPU_NAME": "nehalem", **_OLD_LIBRARIES}),
    # NumPy does not use AVX2, because QEMU 7.2 runs its AVX2 sort wrongly. The kernels are those
    # of the row above.
    "emulated EPYC": Processor(
        {**_KERNELS, "NUMBA_CPU_NAME": "haswell", **_numpy_without(*_AVX2)}, emulated="EPYC"
    ),
}
_DRIVER = "driver "
TASKS = (
    *worlds.ROWS,
    *(f"{_DRIVER}{name}" for name in ("merge_ippo", "roundabout_ippo", "intersection_ippo")),
)
QUICK_TASKS = ("two", "trained")
SHORT_TASKS = ("two:5", "rig:2")  # shorter tasks for emulation
FIRST_STEP = ("two:1",)
QUICK = tuple(name for name, processor in PROCESSORS.items() if processor.is_quick)
EMULATED = ("kernels for Haswell", "emulated EPYC")


def run_task(task: str, folder: str) -> dict[str, str]:
    """Return the hashes of a row, or of the tables of a driver."""
    if task.startswith(_DRIVER):
        return _drive_zoo(task.removeprefix(_DRIVER))
    name, _, steps = task.partition(":")
    row = worlds.ROWS[name]
    return worlds.drive(row._replace(steps=int(steps)) if steps else row, {}, folder)


def _drive_zoo(driver: str) -> dict[str, str]:
    folder = policy_files(driver)[0].parent
    job = entry_job(read_closed(folder / RESULT_FOLDER), folder)
    with tempfile.TemporaryDirectory() as room:
        out = Path(room, "again")
        job.drive(driver, folder, out)
        return {name: hash_of_file(out / name) for name in TABLES if (out / name).exists()}


def hashes(processor: Processor, tasks: tuple[str, ...], folder: str) -> Iterator[dict[str, Any]]:
    """Yield the hashes of each task, run in another process; `{"error": …}` if it fails."""
    with tempfile.TemporaryDirectory() as cache:
        kernels = cache_dir() / "kernels"
        kernels.mkdir(parents=True, exist_ok=True)
        Path(cache, "kernels").symlink_to(kernels)  # their names contain the processor
        settings = {**os.environ, "CAVMARL_CACHE_DIR": cache, **processor.settings}
        command = [sys.executable, "-m", "tests.golden.portability", "--run", folder]
        if processor.emulated:
            command = [_QEMU, "-cpu", processor.emulated, *command]
        for task in tasks:
            done = subprocess.run([*command, task], env=settings, capture_output=True, text=True)
            if done.returncode:
                yield {"error": (done.stderr.strip() or "no message").splitlines()[-1]}
            else:
                yield json.loads(done.stdout.splitlines()[-1])


def reason_to_skip(processor: Processor) -> str:
    """Return the reason why this machine cannot imitate a processor, or an empty text."""
    if processor.emulated:
        return "" if shutil.which(_QEMU) else f"{_QEMU} is not installed"
    if processor.settings.get(_NUMPY) == "":
        return "NumPy does not use these instructions here"
    return ""


def compare(
    names: Iterable[str], tasks: tuple[str, ...], short: tuple[str, ...] = SHORT_TASKS
) -> int:
    """Run tasks on processors, print the differences, and return the exit code.

    Args:
        names: names in `PROCESSORS`.
        tasks: tasks to run on each processor.
        short: tasks to run on emulated processors instead.
    """
    has_failed = False
    processors = {name: PROCESSORS[name] for name in names}
    is_emulated = any(processor.emulated for processor in processors.values())
    with tempfile.TemporaryDirectory() as folder:
        worlds.write_inputs(folder)
        asked = tuple(dict.fromkeys((*tasks, *short) if is_emulated else tasks))
        expected = dict(zip(asked, hashes(Processor({}), asked, folder), strict=True))
        for name, processor in processors.items():
            mine = short if processor.emulated else tasks
            skipped = reason_to_skip(processor)
            found = iter([]) if skipped else hashes(processor, mine, folder)
            for task in mine:
                said = f"skipped: {skipped}" if skipped else _compared(expected[task], next(found))
                has_failed |= said.startswith("DIFFERENT")
                print(f"{name:28} {task:26} {said}", flush=True)
    return int(has_failed)


def _compared(expected: dict[str, Any], found: dict[str, Any]) -> str:
    for hashed in (expected, found):
        if "error" in hashed:
            return f"DIFFERENT: {hashed['error']}"
    parts = [part for part in expected | found if expected.get(part) != found.get(part)]
    return f"DIFFERENT: {', '.join(parts)}" if parts else "same"


def main() -> int:
    """Compare processors; with `--run`, run one task and print its hashes."""
    parser = argparse.ArgumentParser(description="Compare runs on imitated processors.")
    parser.add_argument("--quick", action="store_true", help="less than a minute")
    parser.add_argument("--emulated", action="store_true", help="one step on emulated processors")
    parser.add_argument("--run", metavar="FOLDER", help=argparse.SUPPRESS)
    parser.add_argument("task", nargs="?", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.run is None:
        if given.emulated:
            return compare(EMULATED, FIRST_STEP, FIRST_STEP)
        return compare(QUICK, QUICK_TASKS) if given.quick else compare(PROCESSORS, TASKS)
    print(json.dumps(run_task(given.task, given.run)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
