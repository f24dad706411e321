"""Driver networks under other instruction sets: the same bytes as on this processor."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core import config

from tests.policies.test_network_kernels import DIGEST

CODE = (
    "from tests.policies.test_network_kernels import run_all_kinds;"
    "from cavmarl.policies.kernels.inference import evaluate_network;"
    "print(run_all_kinds(), 'ymm' in next(iter(evaluate_network.inspect_asm().values())))"
)


@pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")
@pytest.mark.parametrize(
    ("processor", "has_avx"), [("haswell", "True"), ("nehalem", "False"), ("host", "")]
)
def test_kernels_for_other_processors_give_the_same_bytes(
    processor: str, has_avx: str, tmp_path: Path
) -> None:
    environment = {**os.environ, "CAVMARL_CACHE_DIR": str(tmp_path)}
    if processor != "host":
        # Without the second setting, Numba takes the features of this processor for the other one.
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
    digest, has_ymm = ran.stdout.split()
    assert digest == DIGEST
    assert has_avx in ("", has_ymm)  # the code does differ
