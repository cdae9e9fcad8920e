"""What is in a log: its scans, their poses, and the map that they would make."""

import numpy as np

from tilestream.apps.info.record import Info, heights_of, utc
from tilestream.formats import describe
from tilestream.formats.logs import open_log
from tilestream.settings import LogOptions


def described(path: str, options: LogOptions) -> Info:
    """A log: its scans, their poses, and the map that they would make."""
    log, found = open_log(path, options), describe(path, **options.given)
    return Info(
        path=found.path,
        kind="log",
        format=found.format,
        size_bytes=found.size_bytes,
        frames={"scans": log.frame},
        bounds=found.bounds,
        heights=heights_of(found.bounds),
        points=found.points,
        fields=found.fields,
        coverage={
            "length_m": log.length_m(np.arange(len(log))),
            "scans": len(log),
            "scans_with_pose": int(log.posed.sum()),
            "poses": len(log.trajectory.stamps_ns),
            "from": utc(int(log.stamps_ns[0])),
            "until": utc(int(log.stamps_ns[-1])),
        },
        contents=found.contents,
        notes=found.notes,
    )
