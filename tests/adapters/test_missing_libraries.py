"""If the library of an adapter is missing, the error names the extra to install."""

from __future__ import annotations

import importlib
import sys

import pytest

from cavmarl.core.errors import MissingExtraError


@pytest.mark.parametrize(
    ("view", "library", "extra"),
    [
        ("sb3_vec_env", "stable_baselines3", "train"),
        ("torchrl_env", "torch", "torchrl"),
        ("torchrl_env", "torchrl", "torchrl"),
        ("benchmarl_task", "benchmarl", "benchmarl"),
        ("rllib_env", "ray", "rllib"),
    ],
)
@pytest.mark.filterwarnings("ignore")  # TorchRL warns about its own code
def test_the_error_for_a_missing_library_names_the_extra(
    monkeypatch: pytest.MonkeyPatch, view: str, library: str, extra: str
) -> None:
    pytest.importorskip("torch", reason="needs the extra: train")

    class Hidden:
        def find_spec(self, name: str, path: object = None, target: object = None) -> None:
            if name.split(".")[0] == library:
                raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    for name in [*sys.modules]:
        if name.split(".")[0] == library or name == f"cavmarl.adapters.{view}":
            monkeypatch.delitem(sys.modules, name)
    if extra == "benchmarl":
        pytest.importorskip("torchrl", reason="needs the extra: torchrl")
    monkeypatch.setattr(sys, "meta_path", [Hidden(), *sys.meta_path])
    with pytest.raises(MissingExtraError, match=rf"'{library}.*pip install .*\[{extra}\]'"):
        importlib.import_module(f"cavmarl.adapters.{view}")
