"""Plugins: modules of users, named by a command, an environment or an installed package."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

import cavmarl
from cavmarl.cli import app
from cavmarl.config.registry import load_config
from cavmarl.core import extensions
from cavmarl.core.errors import CavmarlError, ConfigError
from cavmarl.core.extensions import REGISTERED_SENSORS, REGISTERED_TERMS

PLUGIN = """
import cavmarl

def constant(view):
    return 1.0

cavmarl.register_term("plugged", constant)
cavmarl.register_sensor("plugged", constant, features=[cavmarl.Feature("one", "always 1")])
"""
WEIGHTS = {"progress": 0.1, "plugged": -0.5}


@pytest.fixture(autouse=True)
def _alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Change to a folder with the module `my_plugin`; unload the module after the test."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    (tmp_path / "my_plugin.py").write_text(PLUGIN, encoding="utf-8")
    yield
    monkeypatch.undo()
    extensions.pending_entry_points.cache_clear()
    sys.modules.pop("my_plugin", None)
    for registry in (REGISTERED_TERMS, REGISTERED_SENSORS):
        if "plugged" in registry:
            registry.remove("plugged")


def run(*words: str) -> tuple[int, str]:
    try:
        done = CliRunner().invoke(app, list(words), catch_exceptions=False)
    except CavmarlError as error:
        return 2, str(error)
    return done.exit_code, done.output


def folder_with(plugins: str) -> Path:
    folder = Path("own")
    folder.mkdir()
    text = (Path(str(cavmarl.entries()["ring"])) / "env.yaml").read_text(encoding="utf-8")
    (folder / "env.yaml").write_text(f"{text}\nplugins: {plugins}\n", encoding="utf-8")
    shutil.copytree(cavmarl.entries()["ring"] / "map", folder / "map")
    return folder


def test_a_command_uses_a_term_and_a_sensor_of_the_working_directory() -> None:
    words = ["--set", f"terms.weights={json.dumps(WEIGHTS)}"]
    words += ["--set", 'sensors.registered=["plugged"]', "--repeats", "2", "--episodes", "1"]
    code, said = run("evaluate", "ring", *words, "--out", "found")
    assert code == 2
    assert "--import MODULE" in said
    code, said = run("evaluate", "ring", "--import", "my_plugin", *words, "--out", "found")
    assert code == 0, said
    world = json.loads(Path("found/manifest.json").read_text(encoding="utf-8"))["world"]
    digest = hashlib.sha256(Path("my_plugin.py").read_bytes()).hexdigest()
    assert world["plugins"] == {"my_plugin": digest}
    assert world["config"]["plugins"] == ["my_plugin"]


@pytest.mark.parametrize(
    "words",
    [
        ("baseline", "ring"),
        ("suite", "tasks"),
        ("scenario", "sweep"),
        ("map", "survey", "ring", "-o", "points.ply"),
        ("zoo", "verify", "merge_ippo"),
        ("zoo", "cross", "ring", "-p", "idm", "-p", "idm"),
    ],
)
def test_all_commands_that_make_worlds_have_the_option_import(words: tuple[str, ...]) -> None:
    code, said = run(*words, "--import", "absent")
    assert (code, said.count("there is no module 'absent'")) == (2, 1), said


def test_processes_of_a_suite_import_plugins() -> None:
    Path("own.yaml").write_text("maps: [ring]\n", encoding="utf-8")
    words = ["-n", "1", "-r", "2", "--out", "found"]
    code, said = run("suite", "own.yaml", "--import", "my_plugin", *words)
    assert code == 0, said
    world = json.loads(Path("found/ring/manifest.json").read_text(encoding="utf-8"))["world"]
    assert world["plugins"].keys() == {"my_plugin"}


def test_an_environment_can_list_its_plugins() -> None:
    folder = folder_with("[my_plugin]")
    with pytest.raises(ConfigError, match=r"env\.yaml: plugin 'my_plugin': there is no module"):
        load_config(folder)
    sys.path.append(str(Path.cwd()))
    changes = {"terms.weights": WEIGHTS}
    vec = cavmarl.make_vec(folder, overrides=changes, workers=1)
    vec.reset(seed=0)
    *_, infos = vec.step(vec.suggest_actions())
    vec.close()
    assert (infos["terms"][infos["acted"]][:, -1] == 1.0).all()


def test_overrides_add_to_the_plugins_of_an_environment() -> None:
    folder = folder_with("[math]")
    sys.path.append(str(Path.cwd()))
    config, _ = load_config(folder, overrides={"plugins": ["my_plugin", "math"]})
    assert config.plugins == ("math", "my_plugin")
    with pytest.raises(ConfigError, match="plugins = 'math': must be a list"):
        load_config(folder, overrides={"plugins": "math"})


def install(module: str) -> None:
    """Write the metadata of an installed package that declares a module as a plugin."""
    folder = Path("mine-1.0.dist-info")
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(f"[{extensions.ENTRY_POINTS}]\nplugged = {module}\n")
    sys.path.append(str(Path.cwd()))
    extensions.pending_entry_points.cache_clear()


def test_an_installed_plugin_is_loaded_when_its_term_is_needed() -> None:
    install("my_plugin")
    load_config("ring")
    assert "my_plugin" not in sys.modules
    config, _ = load_config("ring", overrides={"terms.weights": WEIGHTS})
    assert config.terms.registered == ("plugged",)


def test_the_error_for_a_broken_package_names_the_package() -> None:
    install("no_such_module")
    for _ in range(2):
        with pytest.raises(ConfigError, match=r"plugged of the package mine .*no_such_module'"):
            load_config("ring", overrides={"terms.weights": {"none": 1.0}})


@pytest.mark.parametrize(
    ("module", "text", "message"),
    [
        ("my_plugin.py", None, "must be the name of a module, such as my_terms"),
        ("absent", None, "there is no module 'absent'; install its package"),
        ("faulty", "import cavmarl\n1 / 0", r"faulty\.py, line 2: ZeroDivisionError"),
        ("lacking", "import absent", r"lacking\.py, line 1: ModuleNotFoundError"),
    ],
)
def test_the_error_for_a_plugin_that_cannot_be_imported_has_the_reason(
    module: str, text: str | None, message: str
) -> None:
    if text is not None:
        Path(f"{module}.py").write_text(text, encoding="utf-8")
    with pytest.raises(CavmarlError, match=message):
        CliRunner().invoke(app, ["plan", "ring", "--import", module], catch_exceptions=False)


def test_a_second_function_for_a_registered_name_is_refused() -> None:
    def one(view: cavmarl.AgentView) -> float:
        return 1.0

    def other(view: cavmarl.AgentView) -> float:
        return 2.0

    cavmarl.register_term("plugged", one)
    cavmarl.register_term("plugged", one, reach_m=5.0)
    assert REGISTERED_TERMS["plugged"].reach_m == 5.0
    with pytest.raises(ConfigError, match=r"already registered by .* for another function"):
        cavmarl.register_term("plugged", other)
    with pytest.raises(ConfigError, match="already registered"):
        cavmarl.register_term("plugged", lambda view: 0.0)


def test_a_notebook_can_register_a_redefined_function() -> None:
    for weight in (1.0, 2.0):
        names: dict[str, object] = {"__name__": "notebook"}
        exec(f"def constant(view):\n    return {weight}", names)
        cavmarl.register_term("plugged", names["constant"])  # type: ignore[arg-type]
    assert REGISTERED_TERMS["plugged"].function(None) == 2.0


def test_a_second_backend_for_a_registered_name_is_refused() -> None:
    registry = extensions.REGISTERED_BACKENDS
    cavmarl.register_backend("plugged", lambda *_: None)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"backend 'plugged': already registered"):
        cavmarl.register_backend("plugged", lambda *_: None)  # type: ignore[arg-type]
    registry.remove("plugged")
