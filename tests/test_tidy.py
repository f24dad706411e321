"""Rules of style for the package, its tests and pages: names, words and sizes.

Each rule lists its exceptions. The lists should become shorter.
"""

from __future__ import annotations

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.code_bounds import PackageCode, counted_parameters, has_untyped_arguments
from tests.support.cpu_time import (
    ARGUED_S,
    argued,
    costs_of_files,
    is_due,
    known_costs,
    long_tests,
    rare_tests,
)
from tests.support.references import Package
from tests.support.tiers import ALONE_FILES, is_needed

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("cavmarl", "tests", "train", "agents", "fuzz", "docs", "examples", "benchmarks")

# Bounds of sizes that make code hard to follow. The sets have exactly the present exceptions.
PUBLIC_METHODS = 25  # of a class with its bases; properties do not count
WIDE_CLASSES: set[str] = set()

ATTRIBUTES = 20  # attributes that a class and its bases set
LARGE_CLASSES = {
    "cavmarl.handoff.division.ZonedShards",
    "cavmarl.ownership.trace_check.TraceChecker",
    "cavmarl.parallel.nodes.node_peers.NodePeers",
    "cavmarl.parallel.nodes.node_pool.NodePool",
    "cavmarl.parallel.nodes.node_process.NodeProgram",
    "cavmarl.parallel.nodes.zone_endpoints.ZoneEndpoints",
    "cavmarl.shards.shard.Shard",
    "cavmarl.traffic.sumo.sumo_child.SumoSimulation",
}

PARAMETERS = (
    10  # keyword-only parameters of public functions and parameters of kernels do not count
)
WIDE_FUNCTIONS: set[str] = set()

# Functions with untyped `*arguments`, which they pass to a kernel or to another library.
PASSED_ON = {
    "cavmarl.adapters.sb3_vec_env.CavSb3VecEnv.env_method",
    "cavmarl.core.compiled.compiler.KernelCompiler.__init__",
    "cavmarl.core.compiled.inlined_function.InlinedFunction.__call__",
    "cavmarl.core.compiled.intrinsic.Intrinsic.__call__",
    "cavmarl.core.compiled.kernel.Kernel.__call__",
    "cavmarl.core.compiled.kernel._Specialized.__call__",
    "cavmarl.core.compiled.kernel._Unchecked.__call__",
    "cavmarl.core.math.elementary_arrays._mapped",
    "cavmarl.core.records.record",
    "cavmarl.cosim.followers.follower_connection._DeadlineSocket.recv_into",
    "cavmarl.cosim.followers.follower_connection._DeadlineSocket.sendmsg",
    "cavmarl.driving.kernels.models.registered_models._generate_call",
    "cavmarl.evaluate.subprocess_calls._tell",
    "cavmarl.evaluate.subprocess_calls.call_in_fresh_process",
    "cavmarl.parallel.network.encryption.EncryptedSocket.sendmsg",
    "cavmarl.networks.driver_network.LayerTable.add",
    "cavmarl.render.topdown.TopDownRenderer.frame",
}

# The commit that raises one of these bounds gives the reason.
PACKAGE_LINES = 156_650
REACHABLE_LINES = 93_200  # lines that `make_vec` and `parallel_env` can reach

# Module names that occur more than once, outside of cli/ and config/.
SHARED_MODULE_NAMES = {"observations.py"}  # named like sumo-rl's module

# Names of public classes that occur in several modules.
SHARED_CLASS_NAMES = {"Job", "Parameters", "Spread", "Turn", "Within"}

# Public names of Python and of other libraries that begin with an underscore.
UNDERSCORED = {"_asdict", "_exit", "_fields", "_foes", "_multiarray_umath", "_replace"}
UNDERSCORED |= {"_repr_html_"}

# Words for persons that stand for vehicles, zones or workers. Two texts are about pedestrians.
PERSONS = re.compile(r"\b(who|whoever|nobody|somebody)\b", re.IGNORECASE)
PERSONS_AT_MOST = {"cavmarl": 2, "docs": 2}

# Phrases that hide a noun or a verb. Their number in the package and the pages may only fall.
PHRASES = re.compile(
    r"\b(likewise|one that|those that|so many|everybody|of which)\b|\bas of `", re.IGNORECASE
)
PHRASES_AT_MOST = 40

WORDS_OF_A_PAGE = 2500  # tables, generated blocks and code do not count
LONG_PAGES: set[str] = set()


def sources(*folders: str) -> Iterator[tuple[str, str]]:
    """Yield the path within the repository and the text of each Python file."""
    for folder in folders:
        for path in sorted((ROOT / folder).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")


def private_names(text: str) -> list[tuple[int, str]]:
    """Return (line, name) for each private name of another class or module that a file uses."""
    found: list[tuple[int, str]] = []
    for node in ast.walk(ast.parse(text)):
        names: list[str] = []
        match node:
            case ast.Attribute(ast.Name("self" | "cls") | ast.Call(ast.Name("super"))):
                continue
            case ast.Attribute(attr=name):
                names = [name]
            case ast.ImportFrom(names=imported):
                names = [alias.name for alias in imported]
            case ast.Call(
                ast.Name("getattr" | "setattr") | ast.Attribute(attr="setattr" | "delattr"), args
            ):
                words = [word.value for word in args[:2] if isinstance(word, ast.Constant)]
                names = [word.rpartition(".")[2] for word in words if isinstance(word, str)]
        found += [
            (getattr(node, "lineno", 0), name)
            for name in names
            if re.match("_[^_]", name) and name not in UNDERSCORED
        ]
    return sorted(found)


@pytest.fixture(scope="module")
def package() -> PackageCode:
    return PackageCode()


def test_classes_and_functions_have_bounded_sizes(package: PackageCode) -> None:
    classes, functions = list(package.classes()), list(package.functions())
    wide = {name for name, node in classes if len(package.public_methods(node)) > PUBLIC_METHODS}
    large = {name for name, node in classes if len(package.attributes(node)) > ATTRIBUTES}
    assert wide == WIDE_CLASSES, (
        f"update WIDE_CLASSES: classes with over {PUBLIC_METHODS} public methods"
    )
    assert large == LARGE_CLASSES, (
        f"update LARGE_CLASSES: classes with over {ATTRIBUTES} attributes"
    )
    long = {
        name
        for name, node, is_method in functions
        if counted_parameters(node, is_method) > PARAMETERS
    }
    assert long == WIDE_FUNCTIONS, (
        f"update WIDE_FUNCTIONS: functions with over {PARAMETERS} parameters"
    )
    untyped = {name for name, node, _ in functions if has_untyped_arguments(node)}
    assert untyped == PASSED_ON, "name the parameters, or pass a tuple"


def test_the_package_does_not_grow_unnoticed(package: PackageCode) -> None:
    reachable = package.reachable_lines(["cavmarl.env.vector", "cavmarl.env.parallel"])
    everywhere = {
        folder: sum(text.count("\n") for _, text in sources(folder)) for folder in FOLDERS
    }
    print(f"lines reachable from make_vec: {reachable}; of each folder: {everywhere}")
    assert package.lines <= PACKAGE_LINES
    assert reachable <= REACHABLE_LINES


def test_modules_have_different_names() -> None:
    places = defaultdict(list)
    for path, _ in sources("cavmarl"):
        _, *folders, file = path.split("/")
        if not file.startswith("_") and not {"cli", "config"} & set(folders):
            places[file].append(path)
    shared = [
        paths
        for name, paths in places.items()
        if len(paths) > 1 and name not in SHARED_MODULE_NAMES
    ]
    assert not shared, f"rename one module of each list: {shared}"


def test_public_classes_have_different_names() -> None:
    places = defaultdict(list)
    for path, text in sources("cavmarl"):
        for node in ast.parse(text).body:
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name].append(path)
    shared = {name: paths for name, paths in places.items() if len(paths) > 1}
    assert shared.keys() == SHARED_CLASS_NAMES, f"rename all but one class: {shared}"


def test_tests_use_no_private_names() -> None:
    """Only `tests/support` may use private names of the package."""
    found = {
        path: names
        for path, text in sources("tests")
        if not path.startswith("tests/support/") and (names := private_names(text))
    }
    assert not found, "observe it from outside, or make it public"
    used = "a._b\nself._b\nfrom c import _d\nm.setattr('e._f', 1)\nsetattr(g, '_h', 1)\na.__i__"
    assert private_names(used) == [(1, "_b"), (3, "_d"), (4, "_f"), (5, "_h")]


@pytest.mark.parametrize("folder", PERSONS_AT_MOST)
def test_texts_use_no_words_for_persons(folder: str) -> None:
    texts = list(pages().values()) if folder == "docs" else [text for _, text in sources(folder)]
    found = sum(len(PERSONS.findall(text)) for text in texts)
    assert found <= PERSONS_AT_MOST[folder], "say vehicle, zone, worker, message"


def test_texts_have_few_phrases_that_hide_a_noun() -> None:
    texts = [*pages().values(), *(text for _, text in sources("cavmarl"))]
    assert sum(len(PHRASES.findall(text)) for text in texts) <= PHRASES_AT_MOST, "name the noun"


def test_pages_are_short() -> None:
    long = {path for path, text in pages().items() if words_of(text) > WORDS_OF_A_PAGE}
    assert long == LONG_PAGES, f"update LONG_PAGES: pages with over {WORDS_OF_A_PAGE} words"
    assert words_of("one\n| two |\n```\nthree\n```\n<!-- a -->\nfour\n<!-- end -->\nfive") == 2


def pages() -> dict[str, str]:
    """Return the text of each page by its path within the repository."""
    paths = [*(ROOT / "docs").rglob("*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
    return {path.relative_to(ROOT).as_posix(): path.read_text(encoding="utf-8") for path in paths}


def words_of(page: str) -> int:
    """Return the number of words outside of tables, generated blocks and code."""
    prose = re.sub(r"<!-- [\w ]+ -->.*?<!-- end -->|```.*?```", "", page, flags=re.DOTALL)
    return sum(len(line.split()) for line in prose.splitlines() if not line.startswith("|"))


def test_expensive_tests_are_slow_unless_argued_txt_lists_them() -> None:
    costs = {"a[1]": 0.8, "a[2]": 0.3, "a[3]": 0.1, "b[1]": 0.9, "b[2]": 0.8, "c": 9.0, "d": 1.0}
    assert rare_tests(costs, costs) == {"a[1]", "b[1]", "c"}, "the cheapest variants must stay"
    assert rare_tests(costs, costs, frozenset({"c"})) == {"a[1]", "b[1]"}
    assert rare_tests(costs, costs, frozenset({"a[*]"})) == {"b[1]", "c"}
    assert rare_tests([*costs, "b[3]"], costs) == {"a[1]", "b[1]", "b[2]", "c"}


def test_each_slow_test_that_is_not_long_runs_in_one_turn() -> None:
    names = [f"tests/a.py::test[{number}]" for number in range(3000)]
    never = ["tests/a.py::others[1]", "tests/b.py::test", "tests/b.py::test[2]"]
    long = frozenset({"tests/a.py::others", "tests/b.py"})
    for first in (0, 7):
        turns = [
            [name for name in names + never if is_due(name, turn, long)]
            for turn in range(first, first + 30)
        ]
        assert sorted(name for turn in turns for name in turn) == sorted(names), (
            "each slow test must run once"
        )
        assert 50 < min(map(len, turns)) <= max(map(len, turns)) < 150


def test_costs_of_files_are_summed_and_small_tiers_read_few_files() -> None:
    costs = costs_of_files(["a.py::b", "a.py::c[1]", "d.py::e"], {"a.py::b": 2.0, "d.py::e": 9.0})
    assert costs == {"a.py": pytest.approx(2.05), "d.py": 9.0}
    files = [*(ROOT / "tests").rglob("test_*.py")]
    for tier, fewest in (("alone", len(ALONE_FILES)), ("ray", 3), ("twin", 20)):
        read = [path for path in files if is_needed(path, ROOT, f"{tier} and not slow")]
        assert fewest <= len(read) < 0.2 * len(files)
    for expression in ("", "slow", "not alone and not slow", "twin or slow"):
        assert all(is_needed(path, ROOT, expression) for path in files)
    turns = [{path for path in files if is_needed(path, ROOT, "slow", turn)} for turn in range(30)]
    assert max(map(len, turns)) < 0.3 * len(files)
    listed = {name.partition("::")[0] for name in known_costs()}
    assert listed <= {path.relative_to(ROOT).as_posix() for path in set().union(*turns)}


def test_tests_in_argued_txt_are_expensive() -> None:
    alone = [name for name in argued() if not name.endswith("[*]")]
    assert [name for name in alone if known_costs().get(name, 0.0) <= ARGUED_S] == []


def test_the_lists_of_tests_name_existing_tests() -> None:
    for name in (*known_costs(), *argued(), *long_tests()):
        path, test = (*name.split("::"), "")[:2]
        function = test.split("[", 1)[0]
        assert re.search(rf"\b{function}\b", (ROOT / path).read_text(encoding="utf-8")), name


def test_names_in_docstrings_and_comments_exist() -> None:
    """A name is a module, a member of a class, a key of `env.yaml` or a file."""
    package = Package()
    assert package.dead() == []
    text = '"""See `runtime.pool`, `engine.tick.Tick.sense`, `zones.count` and `gone/there.py`."""'
    assert list(package.dead_in(text)) == ["gone/there.py", "runtime.pool"]
