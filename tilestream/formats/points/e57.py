"""E57, the exchange format of terrestrial scanners: several scans in a file, each with its pose.

Needs the extra `e57` (pye57, which brings libE57Format; that checks a CRC of every 1 KB page).
"""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyproj import CRS
from pyproj.exceptions import CRSError

from tilestream.crs import enter, named
from tilestream.errors import CorruptSourceError, CrsError, UnknownFormatError
from tilestream.formats.base import Block, SourceInfo, Span
from tilestream.formats.points.rows import RowSource, finite_block, whole_span
from tilestream.formats.registry import Format
from tilestream.kernels.fixed_order import turned
from tilestream.records import Float64

try:
    from pye57 import libe57
except ModuleNotFoundError as missing:
    if missing.name != "pye57":
        raise
    libe57 = None  # the extra is not installed

_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_STATE = {_CARTESIAN: "cartesianInvalidState", _SPHERICAL: "sphericalInvalidState"}
"""Coordinates that are read, and the field that says whether they are valid."""


@dataclass(frozen=True, eq=False)
class _Scan:
    name: str
    coordinates: tuple[str, ...]
    invalid_state: str | None
    fields: tuple[str, ...]
    span: Span
    R_map_scan: Float64
    t_map_scan: Float64


@dataclass(frozen=True)
class _Scans:
    """The scans of a file, one behind the other, in the frame of the file."""

    path: str
    scans: tuple[_Scan, ...]

    @property
    def count(self) -> int:
        return self.scans[-1].span.stop if self.scans else 0

    def spans(self, points: int) -> list[Span]:  # noqa: ARG002  the same for every format
        """One per scan that has points: a scan is read from its beginning."""
        return [scan.span for scan in self.scans if scan.span.start < scan.span.stop]

    def blocks(self, span: Span, block_points: int) -> Iterator[Block]:
        """The points of a span in blocks; see `PointSource.blocks`."""
        whole_span(span, self.count, self.path)
        with _image(self.path) as image:
            for i, scan in enumerate(self.scans):
                start, stop = max(span.start, scan.span.start), min(span.stop, scan.span.stop)
                if start < stop:
                    yield from self._scan_blocks(image, i, Span(start, stop), block_points)

    def _scan_blocks(self, image: Any, i: int, span: Span, block_points: int) -> Iterator[Block]:
        scan = self.scans[i]
        block_points = min(block_points, scan.span.stop - scan.span.start)
        columns = [np.empty(block_points) for _ in scan.coordinates]
        state = np.zeros(block_points, np.int8)
        with _libe57_errors(self.path, f"scan {i}"):
            reader = _reader(image, i, scan, columns, state)
        at = scan.span.start
        while at < span.stop:
            with _libe57_errors(self.path, f"scan {i} behind point {at - scan.span.start}"):
                got: int = reader.read()
            if not got:
                raise CorruptSourceError(
                    f"{self.path}: scan {i} ends after {at - scan.span.start} points, its header "
                    f"claims {scan.span.stop - scan.span.start}: it is damaged"
                )
            wanted = slice(max(span.start - at, 0), min(span.stop - at, got))
            if wanted.start < wanted.stop:
                yield _placed(scan, [column[wanted] for column in columns], state[wanted])
            at += got
        reader.close()


def open_e57(path: str) -> RowSource:
    """An E57 file; the headers of its scans are read.

    Raises:
        UnknownFormatError: the extra is not installed.
        CorruptSourceError: the file is cut short or damaged, or a scan has no coordinates that can
            be read, no proper pose, or claims more points than the file holds.
        CrsError: its CRS is not in metres.
    """
    if libe57 is None:
        raise UnknownFormatError(f"{path}: E57 needs an extra: pip install 'tilestream[e57]'")
    size_bytes = Path(path).stat().st_size
    with _image(path) as image, _libe57_errors(path, "its header"):
        root = image.root()
        data = root["data3D"] if root.isDefined("data3D") else ()
        scans: list[_Scan] = []
        for i in range(len(data)):
            start = scans[-1].span.stop if scans else 0
            scans.append(_scan(data[i], i, start, path, size_bytes))
        described = _text(root, "coordinateMetadata").strip()
    crs, notes = _crs(described, path)
    found = _Scans(path, tuple(scans))
    names = dict.fromkeys(name for scan in scans for name in scan.fields)
    summary = SourceInfo(
        path=path,
        format="e57",
        size_bytes=size_bytes,
        points=found.count,
        fields=tuple((name, "number") for name in names),
        crs=crs,
        contents=tuple(
            f"scan {i} {scan.name!r}: {scan.span.stop - scan.span.start} points"
            for i, scan in enumerate(scans)
        ),
        notes=notes,
    )
    return RowSource(summary, found)


FORMAT = Format(
    name="E57",
    what="cartesian or spherical scans with their poses (extra `e57`)",
    open=open_e57,
    endings=(".e57",),
    magic=b"ASTM-E57",
)


@contextmanager
def _image(path: str) -> Iterator[Any]:
    with _libe57_errors(path, "its header"):
        image = libe57.ImageFile(path, "r")
    try:
        yield image
    finally:
        image.close()


@contextmanager
def _libe57_errors(path: str, where: str) -> Iterator[None]:
    """Whatever libE57Format raises on damaged bytes, by our name."""
    try:
        yield
    except (CorruptSourceError, MemoryError):
        raise
    except Exception as error:
        raise CorruptSourceError(
            f"{path}: cut short or damaged in {where}: {str(error).strip().splitlines()[0]}; copy "
            "it again from where it came from"
        ) from error


def _scan(node: Any, i: int, start: int, path: str, size_bytes: int) -> _Scan:
    points = node["points"]
    prototype = libe57.StructureNode(points.prototype())
    names = tuple(prototype.get(k).elementName() for k in range(prototype.childCount()))
    known = [coordinates for coordinates in _STATE if set(coordinates) <= set(names)]
    if not known:
        raise CorruptSourceError(
            f"{path}: scan {i} has neither cartesian nor spherical coordinates among its fields "
            f"{', '.join(names)}"
        )
    coordinates, state = known[0], _STATE[known[0]]
    count: int = points.childCount()
    bits = sum(_bits(prototype[name]) for name in coordinates)
    # a point that takes no bits is a copy of the last one
    if not 0 <= count * max(bits, 1) <= 8 * size_bytes:
        raise CorruptSourceError(
            f"{path}: scan {i} claims {count} points of at least {bits} bits, the whole file has "
            f"{size_bytes} bytes: it is damaged"
        )
    R_map_scan, t_map_scan = _pose(node, i, path)
    return _Scan(
        name=_text(node, "name"),
        coordinates=coordinates,
        invalid_state=state if state in names else None,
        fields=names,
        span=Span(start, start + count),
        R_map_scan=R_map_scan,
        t_map_scan=t_map_scan,
    )


def _bits(node: Any) -> int:
    """What a stored number takes at least [bits]."""
    if isinstance(node, libe57.FloatNode):
        return 32 if node.precision() == libe57.E57_SINGLE else 64
    if isinstance(node, libe57.ScaledIntegerNode | libe57.IntegerNode):
        return int(node.maximum() - node.minimum()).bit_length()
    return 0


def _pose(node: Any, i: int, path: str) -> tuple[Float64, Float64]:
    """Rotation and translation from the scan to the file's frame; a scan without pose is in it."""
    q, t = np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
    if node.isDefined("pose"):
        pose = node["pose"]
        if pose.isDefined("rotation"):
            q = np.array([pose["rotation"][axis].value() for axis in "wxyz"])
        if pose.isDefined("translation"):
            t = np.array([pose["translation"][axis].value() for axis in "xyz"])
    norm = math.hypot(*q)
    if not abs(norm - 1.0) < 1e-3 or not np.isfinite(t).all():
        raise CorruptSourceError(
            f"{path}: the pose of scan {i} is not rigid: quaternion {q.tolist()}, translation "
            f"{t.tolist()}"
        )
    w, x, y, z = q / norm
    R_map_scan = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    return R_map_scan, t


def _text(node: Any, name: str) -> str:
    return str(node[name].value()) if node.isDefined(name) else ""


def _crs(described: str, path: str) -> tuple[str | None, tuple[str, ...]]:
    """The CRS of the file's frame, whose points are in metres by the standard.

    Raises:
        CrsError: it is in degrees, or in another unit: which of both is meant no one can tell.
    """
    if not described:
        return None, ()
    try:
        system = CRS.from_user_input(described)
    except CRSError:
        return None, (f"its coordinateMetadata is no CRS that pyproj reads: {described[:200]!r}",)
    found = enter(system, path)
    if not found.metric:
        raise CrsError(
            f"{path}: E57 holds metres, and its CRS {named(system)} is in {found.xy.name}: write "
            "it again with a CRS in metres"
        )
    return found.crs, found.notes


def _reader(
    image: Any, i: int, scan: _Scan, columns: list[Float64], state: NDArray[np.int8]
) -> Any:
    buffers = libe57.VectorSourceDestBuffer()
    targets: dict[str, NDArray[Any]] = dict(zip(scan.coordinates, columns, strict=True))
    if scan.invalid_state is not None:
        targets[scan.invalid_state] = state
    for name, target in targets.items():
        buffers.append(libe57.SourceDestBuffer(image, name, target, len(target), True, True))
    return image.root()["data3D"][i]["points"].reader(buffers)


def _placed(scan: _Scan, columns: list[Float64], state: NDArray[np.int8]) -> Block:
    """The valid points of a scan in the file's frame."""
    valid = state == 0  # 1: only the direction is known, 2: nothing is
    a, b, c = (column[valid] for column in columns)
    if scan.coordinates == _SPHERICAL:
        r, azimuth, elevation = a, b, c
        a = r * np.cos(elevation) * np.cos(azimuth)
        b = r * np.cos(elevation) * np.sin(azimuth)
        c = r * np.sin(elevation)
    points = turned(scan.R_map_scan, np.column_stack([a, b, c])) + scan.t_map_scan
    block = finite_block(*np.ascontiguousarray(points.T))
    return Block(block.points, block.dropped + int(np.count_nonzero(~valid)))
