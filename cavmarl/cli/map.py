"""`cavmarl map`: builds, checks, exports, compares and divides road networks."""

from __future__ import annotations

from functools import partial

import typer

from cavmarl.cli import map_build, map_check, map_export, map_fidelity, map_survey, map_zones
from cavmarl.cli.output import CliGroup, add_command

app = typer.Typer(
    cls=CliGroup,
    help="Build, check, export, compare and divide road networks.",
    no_args_is_help=True,
)
_add = partial(add_command, app)

_add(
    "build",
    map_build.build,
    "cavmarl map build city.osm.xml --dem heights.tif",
    "cavmarl map build road.xodr --out road.net.xml --tolerant",
)
_add(
    "check",
    map_check.check,
    "cavmarl map check city.net.xml --page check.html",
    "cavmarl map check city.net.xml --fix repaired.net.xml",
    "cavmarl map check city.xodr --carla",
)
_add(
    "export",
    map_export.export,
    "cavmarl map export city.net.xml --opendrive city.xodr --geojson lanes.geojson",
)
_add(
    "zones",
    map_zones.zones,
    "cavmarl map zones town --count 9 --picture zones.png",
    "cavmarl map zones town --count 4 --avoid-junctions --out zones.json",
)
_add(
    "fidelity",
    map_fidelity.fidelity,
    "cavmarl map fidelity city.net.xml scan.laz --frame projected --page fidelity.html",
)
_add("survey", map_survey.survey, "cavmarl map survey town --out cloud.ply --vehicles 4")
