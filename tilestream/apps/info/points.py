"""What is in a file of points, or a map directory."""

from tilestream.apps.info.record import Info, heights_of
from tilestream.formats import describe
from tilestream.settings import LogOptions


def described(path: str, _: LogOptions) -> Info:
    """A file of points, or a map directory."""
    found = describe(path)
    return Info(
        path=found.path,
        kind="points",
        format=found.format,
        size_bytes=found.size_bytes,
        crs=found.crs,
        bounds=found.bounds,
        heights=heights_of(found.bounds),
        points=found.points,
        fields=found.fields,
        contents=found.contents,
        notes=found.notes,
    )
