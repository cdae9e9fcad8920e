"""Settings: frozen pydantic models; a unit and a meaning per field; unknown keys refused."""

import difflib
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from tilestream.errors import UsageError


class Settings(BaseModel):
    """Base of all settings: frozen; an unknown key is an error at every level.

    Raises:
        UsageError: a value that cannot be; names each key and what is wrong with it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            raise UsageError(
                f"{type(self).__name__}: "
                + "; ".join(_readable(error, list(type(self).model_fields)))
            ) from None


def _readable(error: ValidationError, known: list[str]) -> Iterator[str]:
    for problem in error.errors():
        key = ".".join(str(part) for part in problem["loc"])
        if problem["type"] == "extra_forbidden":
            near = difflib.get_close_matches(key, known, n=1)
            hint = f"did you mean {near[0]}?" if near else f"known are {', '.join(known)}"
            yield f"{key} is no setting: {hint}"
        elif problem["type"] == "value_error":
            yield f"{key} {problem['msg'].removeprefix('Value error, ')}".strip()
        else:
            yield f"{key} is {problem['input']!r}: {problem['msg']}"


class IngestSettings(Settings):
    """How a map is cut into tiles."""

    tile_size: float = 100.0
    """Edge of a tile [m], whole millimetres, a multiple of every cell size that will be used."""
    halo: float = 10.0
    """What tasks read around a tile [m]; 10 m is the reach of the terms of 2 m cells."""
    map_leaf: float = 0.2
    """Edge of the voxels that the map is thinned to, one centroid each [m]; 0 keeps all points."""
    crs: str | None = None
    """CRS of the map, any string that pyproj reads; None: that of the sources."""
