"""SUMO's configuration files: options, file names and variables are read as SUMO reads them."""

from __future__ import annotations

import gzip
import re
import subprocess
from pathlib import Path

import pytest

from cavmarl.core.errors import DemandError, MapError
from cavmarl.core.xml_root import is_sumo_config, root_tag
from cavmarl.maps.netconvert import map_file
from cavmarl.roads.sumo_net.sumo_options import (
    differs_from_default,
    files_of,
    known_options,
    map_of_config,
    read_options,
)

_OPTION = re.compile(
    r'        <([\w.-]+) value="(.*?)"(?: synonymes="(.*?)")?(?: deprecated=".*?")? type="\w+'
)


def write(folder: Path, body: str, name: str = "x.cfg", root: str = "configuration") -> Path:
    path = folder / name
    path.write_text(f"<{root}>{body}</{root}>", encoding="utf-8")
    return path


def test_every_option_of_sumo_is_known(tmp_path: Path) -> None:
    sumo = pytest.importorskip("sumo", reason="needs the extra 'sumo'")
    template = tmp_path / "all.cfg"
    program = Path(sumo.SUMO_HOME) / "bin" / "sumo"
    subprocess.run([program, "--save-template", template], check=True, capture_output=True)
    text = template.read_text(encoding="utf-8", errors="replace")
    theirs = {
        name: (option, default)
        for option, default, synonyms in _OPTION.findall(text)
        for name in (option, *synonyms.split())
    }
    assert len(theirs) > 500
    theirs["osg-view"] = ("osg-view", "false")  # only builds with OpenSceneGraph have this option
    assert theirs == {name: (o.name, o.default) for name, o in known_options().items()}


def test_an_option_may_have_any_of_its_names_in_any_section(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        '<input>\n<net v="a.net.xml"/><r>b.rou.xml</r></input><e value="60"/><scale value=""/>',
    )
    given = read_options(path, DemandError)
    assert {name: option.value for name, option in given.items()} == {
        "net-file": "a.net.xml",
        "route-files": "b.rou.xml",
        "end": "60",
    }
    assert given["net-file"].line == 2


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('<net-f value="a"/>', "<net-f> is not an option of SUMO: did you mean net-"),
        ('<r value="a"/>\n<routes value="b"/>', "line 2: <routes> sets route-files again"),
    ],
)
def test_options_that_sumo_refuses_are_refused(tmp_path: Path, body: str, words: str) -> None:
    with pytest.raises(DemandError, match=re.escape(words)):
        read_options(write(tmp_path, body), DemandError)


def test_names_of_files_are_read_as_sumo_reads_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PLACE", "sub")
    (tmp_path / "sub").mkdir()
    names = ["a b.xml", "c d.xml", "sub/e.xml", "f.xml"]
    for name in names:
        (tmp_path / name).touch()
    value = " a%20b.xml , c d.xml,${PLACE}/e.xml,${NO_SUCH_VARIABLE}f.xml,"
    path = write(tmp_path, f'<route-files value="{value}"/>')
    found = files_of(path, read_options(path, DemandError), ["route-files"], DemandError)
    assert found == [tmp_path / name for name in names]
    path = write(tmp_path, '\n<a value="f.xml,gone.xml"/>')
    with pytest.raises(DemandError, match=r"line 2: <additional-files> names .*gone\.xml"):
        files_of(path, read_options(path, DemandError), ["additional-files"], DemandError)


def test_a_configuration_is_recognized_by_its_root_element(tmp_path: Path) -> None:
    assert is_sumo_config(write(tmp_path, "", "plain.xml"))
    assert is_sumo_config(write(tmp_path, "", "plain.txt", "sumoConfiguration"))
    assert is_sumo_config(tmp_path / "gone.sumocfg")
    assert not is_sumo_config(write(tmp_path, "", "r.xml", "routes"))
    assert not is_sumo_config(tmp_path / "gone.xml")
    assert not is_sumo_config(tmp_path)
    long = tmp_path / "long.xml.gz"
    text = f'\ufeff<?xml version="1.0"?>\n<!-- <routes/> {"-" * 5000} -->\n<configuration a="1"/>'
    long.write_bytes(gzip.compress(text.encode()))
    assert root_tag(long) == "configuration"


def test_a_configuration_is_accepted_in_place_of_its_map(tmp_path: Path) -> None:
    (tmp_path / "a.net.xml").write_text("<net/>", encoding="utf-8")
    path = write(tmp_path, '<n value="a.net.xml"/>')
    assert map_of_config(path) == map_file(path) == tmp_path / "a.net.xml"
    with pytest.raises(MapError, match="names 0 networks under <net-file>"):
        map_of_config(write(tmp_path, ""))
    with pytest.raises(MapError, match=r"names .*gone\.net\.xml"):
        map_of_config(write(tmp_path, '<n value="gone.net.xml"/>'))


def test_other_files_are_refused_as_configurations(tmp_path: Path) -> None:
    with pytest.raises(DemandError, match=r"<routes> is not the root of a SUMO configuration"):
        read_options(write(tmp_path, "", root="routes"), DemandError)


def test_values_are_compared_with_defaults_by_number_or_truth() -> None:
    known = known_options()
    assert not differs_from_default(known["scale"], "1.0")
    assert differs_from_default(known["scale"], "2")
    assert not differs_from_default(known["with-taz"], "False")
