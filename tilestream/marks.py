"""What became of a piece of work: one mark for a tile's arrays, a Parquet table and any file."""

import dataclasses
import hashlib
import json
import os
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel

from tilestream.version import VERSION


def parsed(text: str | bytes) -> Any:
    """The value of a JSON text that we have written.

    Raises:
        ValueError: it is none, or brackets within brackets as only damage has them.
    """
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("nested too deep") from None


Status = Literal["missing", "damaged", "done", "failed", "skipped"]


@dataclass(frozen=True)
class Mark:
    """What became of a table; written last, checked by every reader."""

    status: Status
    """`done`: whole. All others: not there, and `reason` says why."""
    reason: str = ""
    """Why it failed or was skipped."""
    identity: str = ""
    """Hash of all that it was made from (`identity_of`)."""
    code: str = VERSION
    """Version of the package that made it, for people: the identity does not depend on it."""
    facts: dict[str, Any] = field(default_factory=dict)
    """Small facts that are read without the table: counts, extents, what it was made with."""

    def is_of(self, identity: str) -> bool:
        """Whether the table is whole and was made from this."""
        return self.status == "done" and self.identity == identity


PLAIN = (str, int, float, bool, type(None))
"""Types whose values are their own canonical form."""
SEAL = "checksum"
"""The field of a JSON object that holds the checksum of the others."""
AGAIN = "remove it (`tilestream verify --repair` does) and run the same command again"
"""What to do about a damaged file."""
MISSING = Mark(status="missing", reason="not written yet", code="")


def sealed(content: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON object with the checksum of all else in it."""
    return {**content, SEAL: _seal_of(content)}


def unsealed(content: Any) -> dict[str, Any]:
    """What was sealed.

    Raises:
        ValueError: it is not what it was then.
    """
    if not isinstance(content, Mapping):
        raise ValueError("it is no JSON object")
    inside = {name: value for name, value in content.items() if name != SEAL}
    if content.get(SEAL) != _seal_of(inside):
        raise ValueError("its checksum does not fit")
    return inside


def _seal_of(content: Mapping[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return f"{zlib.crc32(text.encode()):08x}"


def hash_of(*values: Any) -> str:
    """Hex digest (128 bit) of values, the same on every machine; see `canonical`."""
    text = json.dumps(canonical(values), sort_keys=True, separators=(",", ":"))
    return hashlib.blake2b(text.encode(), digest_size=16).hexdigest()


def identity_of(
    stage: str, version: int, takes: Mapping[str, Any], reads: Mapping[str, Any]
) -> str:
    """The identity of what a stage makes: the same work has the same, and only that.

    Args:
        stage: name of the stage.
        version: its version.
        takes: the settings that its function takes, by argument.
        reads: the identities of what it reads, by argument.
    """
    return hash_of(stage, version, takes, reads)


@lru_cache
def _name_of(dtype: np.dtype[Any]) -> str:
    """How numpy writes a type, which takes it long for records."""
    return str(dtype)


def canonical(value: Any) -> Any:
    """A value as JSON holds it: settings and records by field, arrays by the hash of their bytes.

    Raises:
        TypeError: a value of a type that has no such form.
    """
    if type(value) in PLAIN:  # most values of a plan are …
        return value
    if isinstance(value, tuple | list):  # … or these
        return [inner if type(inner) is str else canonical(inner) for inner in value]
    if isinstance(value, BaseModel):
        return canonical(value.model_dump())
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: canonical(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(name): canonical(inner) for name, inner in value.items()}
    if isinstance(value, np.ndarray):
        digest = hashlib.blake2b(np.ascontiguousarray(value).tobytes(), digest_size=16)
        return [_name_of(value.dtype), list(value.shape), digest.hexdigest()]
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} has no canonical form: {value!r}")
