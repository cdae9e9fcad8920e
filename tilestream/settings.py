"""Settings: frozen pydantic models; unknown keys refused.

The docstring of a field is its documentation: meaning, and the unit in brackets. `tilestream
explain` prints it.
"""

import difflib
import re
from collections.abc import Iterator
from typing import Any, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from tilestream.errors import UsageError

NESTED = re.compile(r" \w+Settings: ")
"""How settings inside others begin what is wrong with them: the key above says which they are."""


class Settings(BaseModel):
    """Base of all settings: frozen; an unknown key is an error at every level.

    Raises:
        UsageError: a value that cannot be; names each key and what is wrong with it.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True
    )

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
            said = problem["msg"].removeprefix("Value error, ")
            yield NESTED.sub(": ", f"{key} {said}").strip()
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


class RegistrationSettings(Settings):
    """The matcher: 3D-NDT as definitions, section 5.1, fixes it. It decides the label."""

    neighbours: Literal["direct1", "direct7", "radius"] = "direct7"
    """Cells that score a scan point: that of its own voxel, also the six that share a face (Koide,
    ndt_omp), or all whose mean lies within one cell size (PCL, Autoware)."""
    solver: Literal["definite", "raw"] = "definite"
    """Newton step: always climbing (|eigenvalues|, 10 m per rad), or from the Hessian as it is,
    turned round if it descends (PCL, Autoware, very likely the paper)."""
    rotation: Literal["exponential", "euler"] = "exponential"
    """What a rotation step changes: R <- Exp(w) R, or the angles of R = Rx Ry Rz (PCL, Autoware).
    Either way about the scan's origin."""
    covariance: Literal["regularised", "seeded"] = "regularised"
    """Covariance of a cell: regularised (definitions, section 1), or with the identity that PCL and
    Autoware start their sums from, Sigma + I / (n - 1), eigenvalues at least 0.01 lam1."""
    step_max: float = Field(default=0.1, gt=0.0)
    """Longest step, the norm of metres and radians together [m, rad] (Autoware's step_size)."""
    epsilon: float = Field(default=0.01, gt=0.0)
    """A start has converged when a step is shorter than this [m, rad] (Autoware's
    trans_epsilon)."""
    iterations_max: int = Field(default=30, ge=0, le=10_000)
    """Most steps of a start (Autoware's max_iterations); 0 scores the starts as they are."""
    outlier_ratio: float = Field(default=0.55, gt=0.0, lt=1.0)
    """Share of outliers in Magnusson's density, no unit (PCL's default)."""
    scan_leaf: float = Field(default=2.0, ge=0.0)
    """Edge of the voxels of the lidar frame that the scan is thinned to, one centroid each [m]; the
    paper takes the cell size. A thinned scan is its own thinning. 0 takes the scan as given."""

    @classmethod
    def autoware(cls, **changes: Any) -> Self:
        """The production matcher: Autoware's NDT with its default settings.

        Args:
            changes: fields to set otherwise.
        """
        preset = {
            "neighbours": "radius",
            "solver": "raw",
            "rotation": "euler",
            "covariance": "seeded",
        }
        return cls(**(preset | changes))


class StartSettings(Settings):
    """The starts around a true pose: the paper's initial guess particles (its section VI)."""

    radius: float = Field(default=2.0, ge=0.0)
    """Radius of the disc of starts in map x and y [m]."""
    step: float = Field(default=0.2, gt=0.0)
    """Spacing of the starts on it [m]."""
    yaw: tuple[float, ...] = Field(default=(0.0,), min_length=1)
    """Turns about the map's z axis; every start is tried with each [rad]."""
    z: tuple[float, ...] = Field(default=(0.0,), min_length=1)
    """Offsets in map z; every start is tried with each [m]."""
