"""Driver networks compiled for other processors compute the same bytes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cavmarl.core.compiled import IS_PLAIN
from cavmarl.core.compiled.kernel_files import unpack
from tests.networks.test_network_kernels import DIGEST

CODE = "from tests.networks.test_network_kernels import run_all_kinds; print(run_all_kinds())"


@pytest.mark.skipif(IS_PLAIN, reason="nothing is compiled")
@pytest.mark.parametrize(
    ("processor", "has_avx"), [("haswell", "True"), ("nehalem", "False"), ("host", "")]
)
def test_kernels_for_other_processors_give_the_same_bytes(
    processor: str, has_avx: str, tmp_path: Path
) -> None:
    environment = {**os.environ, "CAVMARL_CACHE_DIR": str(tmp_path), "CAVMARL_KERNELS": "native"}
    if processor != "host":
        # Without the second variable, Numba uses the features of this processor.
        environment |= {"NUMBA_CPU_NAME": processor, "NUMBA_CPU_FEATURES": ""}
    root = Path(__file__).resolve().parents[2]
    ran = subprocess.run(
        [sys.executable, "-c", CODE],
        capture_output=True,
        text=True,
        check=True,
        env=environment,
        cwd=root,
    )
    assert ran.stdout.split() == [DIGEST]
    if has_avx and shutil.which("objdump"):
        assert str(_has_wide_registers(tmp_path)) == has_avx  # AVX code has these registers


def _has_wide_registers(cache: Path) -> bool:
    (path,) = cache.rglob("evaluate_network.*.kernel")
    found = unpack(path.read_bytes())
    assert found is not None
    path.with_suffix(".o").write_bytes(found.code)
    command = ["objdump", "--disassemble", str(path.with_suffix(".o"))]
    return "%ymm" in subprocess.run(command, capture_output=True, text=True, check=True).stdout
