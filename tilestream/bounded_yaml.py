"""YAML as every file of ours is read: within bounds, so that no text is larger than it looks.

A few lines of aliases can stand for a million values, a word for a number of a million digits.
"""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import yaml

from tilestream.errors import SourceNotFoundError, TilestreamError, foreign_errors

MAX_BYTES = 1 << 24
"""Longest text: the list of a city's tiles takes 12 MB."""
MAX_VALUES = 1_000_000
"""Most values, those that aliases repeat counted each time."""
MAX_DEPTH = 32
"""Deepest nesting of lists and mappings."""
TAB = re.compile(r"^ *\t", re.MULTILINE)
"""What indents a line and may not."""
MAX_DIGITS = 20
"""Longest whole number, its sign and prefix included: 64 bits fit."""


def read_yaml(path: Path, kind: type[TilestreamError]) -> Any:
    """The value that a YAML file holds.

    Raises:
        SourceNotFoundError: there is no such file.
        TilestreamError: of this kind; no YAML, a key that is there twice, or beyond the bounds.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except FileNotFoundError as error:
        raise SourceNotFoundError(f"{path}: no such file") from error
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise kind(f"{path}: is no text, and YAML is wanted: name another file") from None
    tabs = "indent with spaces, not with tabs" if TAB.search(text) else ""
    with foreign_errors(kind, f"{path}: is no readable YAML", tabs or "mend it, or copy it again"):
        return parse_yaml(text)


def parse_yaml(text: str) -> Any:
    """The value that a YAML text holds.

    Raises:
        ValueError: a value that cannot be, a key that is there twice, or beyond the bounds.
        YAMLError: no YAML.
        Exception: of any type, where a tag does not fit its value.
    """
    if len(text) > MAX_BYTES:
        raise ValueError(f"longer than {MAX_BYTES} bytes")
    _check_bounds(yaml.parse(text, yaml.CSafeLoader))
    return yaml.load(text, _Loader)


def _check_bounds(events: Iterator[Any]) -> None:
    """Count what a text would become, before anything of it is made."""
    values = 0
    open_: list[tuple[str | None, int]] = []
    sizes: dict[str | None, int] = {}
    for event in events:
        if isinstance(event, yaml.AliasEvent):
            values += sizes.get(event.anchor, MAX_VALUES + 1)  # unknown, or inside of itself
        elif isinstance(event, yaml.ScalarEvent):
            values += 1
            sizes[event.anchor] = 1
        elif isinstance(event, yaml.CollectionStartEvent):
            open_.append((event.anchor, values))
            sizes.pop(event.anchor, None)
            values += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = open_.pop()
            if anchor is not None:
                sizes[anchor] = values - before
        if values > MAX_VALUES or len(open_) > MAX_DEPTH:
            raise ValueError(
                f"more than {MAX_VALUES} values, or deeper than {MAX_DEPTH} levels, with its "
                f"aliases up to line {event.start_mark.line + 1}"
            )


class _Loader(yaml.CSafeLoader):
    """Plain values only, whole numbers of 64 bits, each key once."""

    def construct_yaml_int(self, node: yaml.ScalarNode) -> int:
        if len(node.value) > MAX_DIGITS:
            raise ValueError(f"line {node.start_mark.line + 1}: a number that is too long")
        return int(super().construct_yaml_int(node))

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        if isinstance(node, yaml.MappingNode):
            keys: set[Any] = set()
            for key, _ in node.value:
                name = (key.tag, key.value) if isinstance(key, yaml.ScalarNode) else None
                if name is not None and name in keys:
                    where = key.start_mark.line + 1
                    raise ValueError(f"line {where}: {key.value!r} is there twice")
                keys.add(name)
        return super().construct_mapping(node, deep=deep)


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)
