"""Points as they are written to a file: a table of named columns."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray

from tilestream.errors import UsageError
from tilestream.records import Float64

_FLOAT32_LOSS = 1e-4
"""Largest rounding that a writer accepts before it chooses float64 [m]."""


def as_points(points: ArrayLike) -> Float64:
    """(n, 3) float64 from what a caller gave to a writer.

    Raises:
        UsageError: another shape.
    """
    table = np.asarray(points, dtype=np.float64)
    if table.ndim != 2 or table.shape[1] != 3:
        raise UsageError(f"points of shape {table.shape}: give (n, 3)")
    return table


def coordinate_type(points: Float64) -> DTypeLike:
    """float32 where that moves no coordinate by more than 0.1 mm, else float64."""
    finite = points[np.isfinite(points).all(axis=1)]
    with np.errstate(over="ignore"):
        loss = np.abs(finite - finite.astype(np.float32))
    return np.float32 if loss.max(initial=0.0) <= _FLOAT32_LOSS else np.float64


def table_of(points: Float64, fields: dict[str, ArrayLike] | None) -> NDArray[Any]:
    """x, y, z and further fields as one structured array, a row per point.

    Raises:
        UsageError: a field that is no number per point, or a name that files cannot have.
    """
    xyz = np.dtype(coordinate_type(points)).newbyteorder("<")
    further = {name: np.asarray(values) for name, values in (fields or {}).items()}
    for name, values in further.items():
        if values.shape != (len(points),) or values.dtype.kind not in "fiu":
            raise UsageError(
                f"field {name!r}: {values.dtype} of shape {values.shape}; give ({len(points)},) "
                "numbers, one per point"
            )
        if name in ("x", "y", "z") or not name.isidentifier():
            raise UsageError(f"field {name!r}: give a name of letters, digits and _, not x, y or z")
    types = [(name, xyz) for name in "xyz"]
    types += [(name, values.dtype.newbyteorder("<")) for name, values in further.items()]
    table = np.empty(len(points), np.dtype(types))
    for axis, name in enumerate("xyz"):
        table[name] = points[:, axis]
    for name, values in further.items():
        table[name] = values
    return table


def as_text(table: NDArray[Any]) -> bytes:
    """A line per point; every number in the fewest digits that read back the same."""
    columns = [table[name].astype(str) for name in table.dtype.names or ()]
    return "".join(f"{' '.join(row)}\n" for row in zip(*columns, strict=True)).encode()
