"""The matcher's settings: how a scan is registered, and what is done to it before."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import (
    Field,
    PrivateAttr,
    SerializerFunctionWrapHandler,
    model_serializer,
    model_validator,
)

from tilestream.autoware_matcher import read_matcher
from tilestream.config import Settings
from tilestream.errors import UsageError
from tilestream.sensor import Mount

Positive = Annotated[float, Field(gt=0.0)]


class CropSettings(Settings):
    """A box of which the points of a scan are kept, its faces included, or left out."""

    lowest: tuple[float, float, float]
    """Its lowest x, y, z [m]."""
    highest: tuple[float, float, float]
    """Its highest x, y, z [m]."""
    negative: bool = False
    """Leave out what is inside, and keep the rest."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if any(low > high for low, high in zip(self.lowest, self.highest, strict=True)):
            raise ValueError(f"is from {self.lowest} to {self.highest}: give lowest <= highest")
        return self


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
    crop: CropSettings | None = None
    """A box that the scan is cropped to first; not given: none."""
    mount: Mount = Mount()
    """Where the lidar is in the frame of that box (Autoware's base_link)."""
    range_min: float = Field(default=0.0, ge=0.0)
    """Points nearer to the lidar than this are left out, too [m] …"""
    range_max: Positive | None = None
    """… and those farther than this [m]; not given: none."""
    random_sample: Annotated[int, Field(ge=10)] | None = None
    """So many points of the thinned scan are taken at random; not given: all."""
    random_seed: int = Field(default=0, ge=0, lt=2**63)
    """Seed of that choice; the points are part of it too."""
    required_distance: float = Field(default=0.0, ge=0.0)
    """A scan that reaches less far than this, as it is registered, is refused [m]."""
    resolution: Positive | None = Field(default=None, exclude=True)
    """Edge of the NDT cells that the matcher wants [m]; not given: any. A job takes it for its
    own."""
    _notes: tuple[str, ...] = PrivateAttr(default=())

    @model_serializer(mode="wrap")
    def _as_before(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Without the fields that came later where they say nothing: labels and models that know a
        matcher without them stay its own.
        """
        values: dict[str, Any] = dump(self)
        for name in LATER:
            if getattr(self, name) == type(self).model_fields[name].default:
                values.pop(name, None)
        return values

    def require_cells(self, cell_size: float) -> None:
        """Refuse cells that the matcher does not want.

        Raises:
            UsageError: they have another size [m].
        """
        if self.resolution not in (None, cell_size):
            raise UsageError(
                f"the matcher wants cells of {self.resolution:g} m (its resolution), and cell_size "
                f"is {cell_size:g} m: give cell_size={self.resolution:g}"
            )

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of the files that it was read from."""
        return self._notes

    @classmethod
    def of_files(cls, path: str, **changes: Any) -> Self:
        """The matcher of Autoware's `ndt_scan_matcher.param.yaml`, or of a folder with it and the
        filters of its scans (`autoware_matcher`).

        Args:
            path: the file or the folder.
            changes: fields to set otherwise.

        Raises:
            UsageError: it cannot be read as that; names file and key.
        """
        found = read_matcher(path)
        try:
            made = cls.autoware(**{**found.settings, **changes})
        except UsageError as error:
            told = str(error).removeprefix(f"{cls.__name__}: ")
            raise UsageError(f"{path}: {told}") from None
        made._notes = found.notes
        return made

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

    @property
    def told(self) -> str:
        """The matcher in words: the preset that is nearest to it, and what it has otherwise."""
        own = self.model_dump()
        others = {
            name: {key: own[key] for key in own if own[key] != known.model_dump().get(key)}
            for name, known in MATCHERS.items()
        }
        name = min(others, key=lambda name: len(others[name]))
        changes = ", ".join(f"{key} {value}" for key, value in others[name].items())
        return f"{name}, but {changes}" if changes else name


LATER = (
    "crop",
    "mount",
    "range_min",
    "range_max",
    "random_sample",
    "random_seed",
    "required_distance",
)
"""Fields of a matcher that came after version 0.1."""
MATCHERS = {
    "autoware": RegistrationSettings.autoware(),
    "default": RegistrationSettings(),
}
"""The matchers that have a name: that of production, and ours."""


def matcher_named(given: Any) -> Any:
    """A matcher's name as it is, the matcher of a file or a folder (`of_files`); what is neither a
    text nor names a `file` stays as it is.

    Raises:
        UsageError: no such matcher or file, or one that cannot be read.
    """
    if isinstance(given, str) and given not in MATCHERS:
        try:
            return RegistrationSettings.of_files(given)
        except UsageError as error:
            raise UsageError(
                f"{error}; the matchers with a name are {', '.join(MATCHERS)}"
            ) from None
    if isinstance(given, Mapping) and "file" in given:
        changes = {str(key): value for key, value in given.items() if key != "file"}
        return RegistrationSettings.of_files(str(given["file"]), **changes)
    return given
