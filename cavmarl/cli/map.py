"""`cavmarl map`: builds road networks, checks, exports, compares and divides them."""

from __future__ import annotations

import typer

from cavmarl.cli import map_build, map_check, map_export, map_fidelity, map_survey, map_zones

app = typer.Typer(
    help="Build road networks, check that they can be driven, export, compare and divide them.",
    no_args_is_help=True,
)

app.command("build")(map_build.build)
app.command("check")(map_check.check)
app.command("export")(map_export.export)
app.command("zones")(map_zones.zones)
app.command("fidelity")(map_fidelity.fidelity)
app.command("survey")(map_survey.survey)
