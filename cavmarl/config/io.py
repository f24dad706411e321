"""Reads YAML into checked, frozen dataclasses.

YAML is read with the core schema of YAML 1.2 (`1e-3` is a number, `on` and `1:30` are text). Tags,
aliases, duplicate keys, deep nesting and large files raise errors. Types are strict: a bool is not
an int, a quoted number is not a number.
"""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Hashable, Mapping
from copy import deepcopy
from dataclasses import fields, is_dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

import numpy as np
import yaml
from pydantic import ConfigDict, TypeAdapter, ValidationError
from pydantic_core import ErrorDetails

from cavmarl.config.removed_keys import removed_key
from cavmarl.core.errors import ConfigError

T = TypeVar("T")

MAX_BYTES = 1 << 16
MAX_DEPTH = 16

# Units at the end of key names, to suggest `range_m` for `range_km`.
UNITS = frozenset("m km cm mm s ms min h hz mps kmh mph mps2 mps3 rad deg ticks steps".split())


class _CoreLoader(yaml.SafeLoader):
    """YAML 1.2's core schema, without the features that a configuration does not need."""

    yaml_implicit_resolvers = {}  # noqa: RUF012 - PyYAML's API; the resolvers follow below
    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: int) -> yaml.Node | None:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        if isinstance(event, yaml.AliasEvent):
            raise _refusal(f"alias *{event.anchor}: write the value out", event.start_mark)
        if getattr(event, "tag", None) is not None:
            raise _refusal(f"tag {event.tag}: write the plain value", event.start_mark)
        if self.depth == MAX_DEPTH:
            raise _refusal(f"nested more than {MAX_DEPTH} deep", event.start_mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Hashable, Any]:
        seen = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                raise _refusal("a key must be a name", key.start_mark)
            if key.value in seen:
                raise _refusal(f"key '{key.value}' is given twice; keep one", key.start_mark)
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def _refusal(problem: str, mark: Any) -> yaml.MarkedYAMLError:
    return yaml.MarkedYAMLError(problem=problem, problem_mark=mark)


for _tag, _pattern, _first in (
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(?:0|[1-9][0-9]{0,17})", list("-+0123456789")),
    (
        "float",
        r"[-+]?(?:[0-9]+(?:\.[0-9]*)?|\.[0-9]+)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
        list("-+0123456789."),
    ),
):
    _CoreLoader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})\\Z"), _first
    )


def read_yaml(path: Path) -> object:
    """Return the content of a YAML file as plain Python values.

    Raises:
        ConfigError: the file is unreadable, too large, not UTF-8 or not YAML, or has an alias, a
            tag or a duplicate key; the message names the line.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    if len(data) > MAX_BYTES:
        raise ConfigError(f"{path}: larger than {MAX_BYTES // 1024} KiB; is this a configuration?")
    try:
        return deepcopy(_parsed(data.decode()))
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: not UTF-8 at byte {error.start}") from error
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise ConfigError(f"{path}: {line}{error.problem}") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path}: {error}") from error


@lru_cache(maxsize=32)  # many worlds are made from the same files
def _parsed(text: str) -> object:
    loaded: object = yaml.load(text, Loader=_CoreLoader)
    return loaded


def validate(
    kind: type[T], raw: object, where: str, *, extra: Literal["forbid", "ignore"] = "forbid"
) -> T:
    """Build the dataclass `kind` and its nested dataclasses from plain values.

    Args:
        kind: a frozen dataclass.
        raw: mappings, sequences, strings, numbers, bools, None.
        where: start of every message, such as the file of `raw`.
        extra: whether unknown keys raise an error or are ignored.

    Raises:
        ConfigError: a key is unknown or missing, a type is wrong, or `kind` refuses a value. Each
            line of the message names a key, its value and a remedy.
    """
    hashable: Any = kind  # mypy does not accept a type variable here
    if not isinstance(raw, Mapping):
        raise ConfigError(f"{where}: must be a mapping from keys to values, not {raw!r}")
    try:
        # Via JSON, whose strict mode does not distinguish lists from tuples, or mappings from
        # dataclasses. NumPy's numbers count as Python's. Other types become text, which no
        # number field accepts.
        text = json.dumps(raw, default=_plain)
    except (TypeError, ValueError, RecursionError) as error:
        raise ConfigError(f"{where}: has a value that is not allowed ({error})") from error
    try:
        checked: T = _adapter(hashable, extra).validate_json(text)
    except ValidationError as error:
        lines = [_explain(kind, details) for details in error.errors(include_url=False)]
        raise ConfigError("\n".join(f"{where}: {line}" for line in lines)) from error
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    return checked


def _plain(value: object) -> object:
    """Return `value` in a form that JSON can represent."""
    return value.item() if isinstance(value, np.generic) else str(value)


def dotted_keys(kind: type[Any], prefix: str = "") -> list[str]:
    """Return every key of the dataclass `kind` and its sections, such as `sensors.lidar.rays`."""
    keys = []
    for name, hint in _fields(kind).items():
        if isinstance(hint, type) and is_dataclass(hint):
            keys += dotted_keys(hint, f"{prefix}{name}.")
        else:
            keys.append(f"{prefix}{name}")
    return keys


@cache  # building it takes longer than making a small world
def _adapter(kind: type[Any], extra: Literal["forbid", "ignore"]) -> TypeAdapter[Any]:
    """Return pydantic's strict adapter of `kind`.

    It adapts a union, because pydantic ignores `config` for a plain dataclass.
    """
    union: Any = kind | None
    return TypeAdapter(union, config=ConfigDict(extra=extra, strict=True))


def _fields(kind: type[Any]) -> dict[str, Any]:
    """Return the field names of a dataclass with their resolved types."""
    hints = get_type_hints(kind)
    return {field.name: hints[field.name] for field in fields(kind)}


def _explain(kind: type[Any], details: ErrorDetails) -> str:
    """Return one line about an error of pydantic, in the terms of the configuration."""
    location = [str(part) for part in details["loc"]]
    keys, _ = _walk(kind, location)
    path = ".".join(keys)
    match details["type"]:
        case "unexpected_keyword_argument":
            return removed_key(path) or f"{path}: unknown key; {_nearest(kind, location)}"
        case "missing":
            return f"{path}: missing; this key has no default, add it"
        case "dataclass_type" | "dict_type":
            return f"{path} = {details['input']!r}: must be a mapping from keys to values"
        case "union_tag_not_found":
            return f"{path}: must be a mapping with the key type: one of {_types(kind, location)}"
        case "union_tag_invalid":
            tag = details["ctx"]["tag"]
            return f"{path}.type = {tag!r}: must be one of {_types(kind, location)}"
        case "json_invalid":
            return f"has a value that is not allowed ({details['msg']})"
        case "tuple_type":
            return f"{path} = {details['input']!r}: must be a list"
    return f"{path} = {details['input']!r}: {details['msg'].replace('Input should', 'must')}"


def _walk(kind: type[Any], location: list[str]) -> tuple[list[str], Any]:
    """Return the keys of a location, and the type at that location.

    Pydantic puts the member of a union between two keys; those members are left out.
    """
    keys: list[str] = []
    inner: Any = kind
    for part in location:
        if part == "str" or part.startswith(("tuple[", "dict[")):
            inner = next(one for one in get_args(inner) if part.startswith(one.__name__))
            continue
        members = [one for one in get_args(inner) if getattr(one, "type", None) == part]
        if members:
            inner = members[0]
            continue
        keys.append(part)
        if isinstance(inner, type) and is_dataclass(inner):
            inner = _fields(inner).get(part)
        else:  # the values of a mapping, or the items of a list
            arguments = get_args(inner)
            inner = arguments[get_origin(inner) is dict] if arguments else None
    return keys, inner


def _types(kind: type[Any], location: list[str]) -> str:
    """Return the names of the types in a union."""
    return ", ".join(one.type for one in get_args(_walk(kind, location)[1]))


def _nearest(kind: type[Any], location: list[str]) -> str:
    """Return advice for an unknown key: a similar key, or all keys of the section."""
    parents, inner = _walk(kind, location[:-1])
    key = location[-1]
    known = list(_fields(inner))
    for name in known:
        if name != key and _stem(name) == _stem(key):
            return f"use {name} (a name ends with its unit: convert the value)"
    if close := difflib.get_close_matches(key, known, n=1):
        return f"did you mean {'.'.join([*parents, *close])}?"
    elsewhere = [other for other in dotted_keys(kind) if other.split(".")[-1] == key]
    if elsewhere:
        return f"did you mean {elsewhere[0]}?"
    return f"the keys here are: {', '.join(known)}"


def _stem(key: str) -> str:
    """Return a key without its unit: `range_m`, `range_km` and `range` have the same stem."""
    head, _, tail = key.rpartition("_")
    return head if head and tail.lower() in UNITS else key
