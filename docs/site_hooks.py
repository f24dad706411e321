"""Hooks of MkDocs: pages of the site that are made from files outside of `docs/`.

The README is the first page, cards of environments and drivers are pages, the gallery shows their
pictures, and the reference has a part for each public name. Links that leave `docs/` lead to these
pages; links to files of code become the names of the files.
"""

from __future__ import annotations

import ast
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
PUBLIC = ("cavmarl", "cavmarl.client", "cavmarl.evaluate")
SENSORS = {
    "images/sensors.png": "What the sensors of a vehicle see",
    "images/viewer.png": "The viewer: zones, ghosts, an agent's observation",
    "images/ghosts.png": "A divided world: owners, halo and ghosts",
}
_LINK = re.compile(r"\]\((?!https?:|#|mailto:)([^)#\s]+)(#[^)\s]*)?\)")
_SOURCE = re.compile(r"(<img src=\")([^\"]+)")


def sources() -> dict[str, Path]:
    """Return the pages of the site that are outside of `docs/`, by their address."""
    found = {"index.md": ROOT / "README.md"}
    found |= {f"{name.lower()}.md": ROOT / f"{name}.md" for name in ("CONTRIBUTING", "CHANGELOG")}
    for kind in ("envs", "agents"):
        for card in sorted(ROOT.glob(f"{kind}/*/README.md")):
            found[f"{kind}/{card.parent.name}.md"] = card
    return found


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages."""
    made = {address: path.read_text(encoding="utf-8") for address, path in sources().items()}
    made["gallery.md"] = gallery()
    made["reference/api.md"] = reference()
    for address, text in made.items():
        files.append(File.generated(config, address, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:
    """Redirect links to pages of the site."""
    address = page.file.src_uri
    source = sources().get(address, ROOT / "docs" / address)
    here = posixpath.dirname(address)

    def lead(target: str) -> str | None:
        path = (source.parent / target).resolve()
        if path.is_relative_to(ROOT / "docs"):
            found = path.relative_to(ROOT / "docs").as_posix()
        else:
            found = {one: name for name, one in sources().items()}.get(path, "")
        if files.get_file_from_path(found) is None:
            return None
        return posixpath.relpath(found, here or ".")

    def link(match: re.Match[str]) -> str:
        found = lead(match[1])
        return f"]({found}{match[2] or ''})" if found else f"](missing:{match[1]})"

    def picture(match: re.Match[str]) -> str:
        return f"{match[1]}{lead(match[2]) or match[2]}"

    text = _SOURCE.sub(picture, _LINK.sub(link, markdown))
    return re.sub(r"\[((?:[^\[\]]|\[[^\]]*\])*)\]\(missing:[^)]*\)", r"\1", text)


def gallery() -> str:
    """Return the gallery: a picture of each environment, and of sensor data."""
    lines = ["# Gallery", "", "## Environments", ""]
    for card in sorted(ROOT.glob("envs/*/README.md")):
        name = card.parent.name
        text = card.read_text(encoding="utf-8")
        (about,) = re.findall(r"^!\[([^\]]*)\]", text, re.MULTILINE)[:1] or [name]
        lines += [f"### [{name}](../envs/{name}/README.md)", ""]
        lines += [f"![{about}](images/{name}.png)", ""]
    lines += ["## Sensors", "", "Sensor data of one agent, as drawings or numbers.", ""]
    for path in sorted(ROOT.glob("docs/images/sensors/*.png")):
        name = path.stem.replace("rig_", "rig.")
        lines += [f"### {name}", "", f"![{name}](images/sensors/{path.name})", ""]
    lines += ["## All together, and divided worlds", ""]
    for place, about in SENSORS.items():
        lines += [f"![{about}]({place})", "", f"*{about}*", ""]
    return "\n".join(lines)


def reference() -> str:
    """Return the reference: a part for each public name, from its docstring."""
    lines = ["# Reference", "", "Names in `__all__` of packages; keys of environments are in"]
    lines += ["[environments](environments.md), commands in `cavmarl --help`.", ""]
    for module in PUBLIC:
        lines += [f"## {module}", ""]
        for name in public_names(ROOT.joinpath(*module.split("."), "__init__.py")):
            lines += [f"::: {module}.{name}", "    options:", "      heading_level: 3", ""]
    return "\n".join(lines)


def public_names(path: Path) -> list[str]:
    """Return the names in `__all__`, read without importing."""
    for one in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(one, ast.Assign) and ast.unparse(one.targets[0]) == "__all__":
            return [str(name) for name in ast.literal_eval(one.value)]
    return []
