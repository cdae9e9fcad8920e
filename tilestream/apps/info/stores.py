"""What is in a tile store: its tiles, and what it was made from."""

from collections import Counter

import numpy as np

from tilestream.apps.info.record import Info, told
from tilestream.counts import count_of
from tilestream.pipeline.jobs.sources import map_notes
from tilestream.settings import LogOptions
from tilestream.store import POINTS, open_store


def described(path: str, _: LogOptions) -> Info:
    """A tile store: its tiles, and what it was made from."""
    store = open_store(path)
    marks = store.marks(POINTS)
    done = [mark.facts for mark in marks.values() if mark.status == "done"]
    corners = [facts[end] for facts in done for end in ("lowest", "highest")]
    statuses = Counter(mark.status for mark in marks.values())
    settings = store.settings
    return Info(
        path=path,
        kind="map",
        format="tile store",
        state=str(store.condition()),
        crs=settings.crs,
        points=sum(facts["points"] for facts in done),
        coverage={
            "tiles": len(marks),
            **{f"tiles_{status}": count for status, count in sorted(statuses.items())},
            "area_m2": len(done) * settings.tile_size**2,
            "points_read": sum(facts["read"] for facts in done),
        },
        contents=[
            f"tiles of {settings.tile_size:g} m, thinned to {settings.map_leaf:g} m",
            *(
                f"{one['path']}: {one['format']}, {count_of(one['points'], 'point')}"
                for one in store.sources()
            ),
        ],
        notes=told(map_notes(store)),
    ).over(np.array(corners, np.float64).reshape(-1, 3))
