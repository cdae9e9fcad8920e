"""The settings of the main job from a YAML file."""

import os
from collections.abc import Sequence
from pathlib import Path

import yaml
from pydantic import ValidationError

from tilestream.errors import SourceNotFoundError, UsageError
from tilestream.settings import RunSettings


def read_settings(path: str | os.PathLike[str], changes: Sequence[str] = ()) -> RunSettings:
    """The settings of a job from a YAML file; relative paths in it are from where one is.

    Args:
        path: the file.
        changes: `key=value` with dots between levels and YAML values, applied on top.

    Raises:
        SourceNotFoundError: no such file.
        UsageError: no YAML, an unknown key at any level (names the nearest right one), a value that
            cannot be.
    """
    place = Path(path)
    if not place.is_file():
        raise SourceNotFoundError(f"{place}: no such config; `tilestream template` prints one")
    try:
        values = yaml.safe_load(place.read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"{place}: no YAML: {error}") from None
    if not isinstance(values, dict):
        raise UsageError(f"{place}: give the fields of a job, e.g. out: run")
    for change in changes:
        _apply(values, change)
    try:
        return RunSettings(**values)
    except (UsageError, ValidationError, TypeError) as error:
        told = str(error).removeprefix(f"{RunSettings.__name__}: ")
        raise UsageError(f"{place}: {told}") from None


def _apply(values: dict[str, object], change: str) -> None:
    """Set one value; levels that are not there are made, and judged with the rest."""
    key, equals, text = change.partition("=")
    if not equals or not key:
        raise UsageError(f"{change!r}: give key=value, e.g. label.matcher=default")
    *levels, last = key.split(".")
    at = values
    for level in levels:
        below = at.setdefault(level, {})
        if not isinstance(below, dict):
            raise UsageError(f"{change!r}: {level} holds a value, nothing lies below it")
        at = below
    at[last] = yaml.safe_load(text)
