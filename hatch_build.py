"""Hatchling's hook: a wheel gets the library of compiled kernels, so that users compile nothing."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PLACE = "cavmarl/core/compiled/prebuilt"
SETTING = "CAVMARL_BUILD_KERNELS"


class KernelHook(BuildHookInterface[Any]):
    """Compiles the kernels when a wheel is built.

    An editable installation gets none, since its sources may change: it compiles on first use.
    `CAVMARL_BUILD_KERNELS=0` leaves them out of a wheel, too.
    """

    PLUGIN_NAME = "custom"

    def dependencies(self) -> list[str]:
        """Return what the build needs: what kernels import, the compiler, and a linker."""
        if not self._is_wanted(""):
            return []
        project = self.metadata.core
        needed = [*project.dependencies, *project.optional_dependencies["compile"]]
        if not any(map(shutil.which, ("cc", "gcc", "clang"))):
            needed.append("ziglang")
        return needed

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile the kernels into a folder that goes into the wheel."""
        if not self._is_wanted(version):
            return
        self._folder = tempfile.mkdtemp(prefix="cavmarl-kernels-")
        command = [sys.executable, "-m", "cavmarl.prebuild", "build", self._folder]
        # An isolated build finds its own requirements by the path that is set already.
        paths = [self.root, *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
        subprocess.run(command, cwd=self.root, env=environment, check=True)
        for path in Path(self._folder).iterdir():
            build_data["force_include"][str(path)] = f"{PLACE}/{path.name}"
        build_data["pure_python"] = False
        build_data["infer_tag"] = True

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the folder."""
        if folder := getattr(self, "_folder", None):
            shutil.rmtree(folder, ignore_errors=True)

    def _is_wanted(self, version: str) -> bool:
        is_wheel = self.target_name == "wheel" and version != "editable"
        return is_wheel and os.environ.get(SETTING, "1") != "0"
