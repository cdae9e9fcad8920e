"""What a run was before its map was updated: kept beside what it is now.

```
report/places.parquet, report/tiles.json   of the last call that ended
before/places.parquet, before/tiles.json   the same, of before the last update of the map
```
"""

import io
import json
import logging
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import pandas as pd
from yaml import YAMLError

from tilestream.bounded_yaml import parse_yaml
from tilestream.errors import DamagedError, SourceNotFoundError, UsageError
from tilestream.files import Files
from tilestream.grid import TileKey
from tilestream.marks import AGAIN, hash_of, parsed, sealed, unsealed
from tilestream.notes import some_of
from tilestream.pipeline.jobs.map_update import Update
from tilestream.pipeline.jobs.run_book import checksum_of
from tilestream.pipeline.jobs.run_making import making_of
from tilestream.pipeline.jobs.run_names import CONFIG
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.run_state import record_of
from tilestream.pipeline.stages.map_plan import MapPlan

logger = logging.getLogger(__name__)

REPORT, BEFORE = "report", "before"
"""The folders of what is, and of what was."""
PLACES, TILES = "places.parquet", "tiles.json"


@dataclass(frozen=True)
class Told:
    """The map that a report is of."""

    tile_size: float
    """Edge of its tiles [m]."""
    crs: str | None
    """Its CRS; None: a local frame."""
    tiles: Mapping[str, str]
    """The identity of the points of each tile, by name."""
    settings: str
    """Hash of the settings that decide the estimates."""
    places: str
    """Checksum of the file of places beside it."""

    @property
    def keys(self) -> dict[TileKey, str]:
        """The identities by tile."""
        return {TileKey.parse(name): identity for name, identity in self.tiles.items()}


def tell(settings: RunSettings, map_plan: MapPlan) -> None:
    """Write down which map the report is of, once all its files are written."""
    report, store = settings.folder.under(REPORT), map_plan.store.settings
    told = Told(
        store.tile_size,
        store.crs,
        {str(key): tile.identity for key, tile in sorted(map_plan.points.items())},
        _hash(settings),
        checksum_of(report.under(PLACES)),
    )
    text = json.dumps(sealed(asdict(told)), indent=0) + "\n"
    report.under(TILES).write(text.encode())


def say_other_map(settings: RunSettings) -> None:
    """Say so where the run directory holds a run of a map that shares no file with this one's."""
    try:
        text = settings.folder.under(CONFIG).read().decode()
        before, now = _named(parse_yaml(text)["map"]), _named(settings.map.model_dump(mode="json"))
    except (OSError, ValueError, YAMLError, TypeError, KeyError, AttributeError):
        return  # there is none, or it is no one's
    if before and now and not before & now:
        logger.warning(
            "%s holds a run of another map, %s: its report is replaced, its places are kept for "
            "`tilestream diff`",
            settings.out,
            some_of(sorted(before), 1),
        )


def _named(of_map: Mapping[str, Any]) -> set[str]:
    """The files, or the store, that a map is named by."""
    return {*of_map["sources"], *filter(None, [of_map["store"]])}


def update_of(settings: RunSettings, map_plan: MapPlan) -> Update | None:
    """What is new in a map since the last report; None: it is of this map, or there is none that
    says it.
    """
    try:
        told = told_in(settings.folder.under(REPORT))
    except DamagedError:
        return None
    now = {key: tile.identity for key, tile in map_plan.points.items()}
    return None if told is None else Update.between(told.keys, now)


def keep_before(settings: RunSettings) -> None:
    """Keep the last report's places, of a map that is updated now.

    The report is not touched before all else is done: where an update is stopped and called again,
    the same is kept again. A report that was being written when its call was stopped is of the
    updated map, and is not kept.
    """
    report, before = (settings.folder.under(name) for name in (REPORT, BEFORE))
    told, places = told_in(report), report.under(PLACES)
    if told is not None and places.there() and told.places == checksum_of(places):
        before.under(TILES).remove()  # it must not vouch for other places
        before.under(PLACES).write(places.read())
        before.under(TILES).write(report.under(TILES).read())


def told_in(folder: Files) -> Told | None:
    """The map that the places in a folder are of; None: it does not say.

    Raises:
        DamagedError: that is not what was written.
    """
    file = folder.under(TILES)
    try:
        return Told(**unsealed(parsed(file.read())))
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (ValueError, TypeError) as error:
        raise DamagedError(f"{file.address} is damaged ({error}): {AGAIN}") from error


def before_update(run_dir: Files) -> tuple[Told, pd.DataFrame]:
    """The map and the places of a run before its last update.

    Raises:
        SourceNotFoundError: there is no run directory.
        UsageError: the run has not been updated.
        DamagedError: they, or the record of the run, are not what was written.
    """
    if not run_dir.there():
        raise SourceNotFoundError(f"{run_dir.address}: no run directory is there: check the path")
    record_of(run_dir)
    before = run_dir.under(BEFORE)
    told = told_in(before)
    if told is None:
        raise UsageError(
            f"{run_dir.address} keeps no estimates of before: its map was not updated there; name "
            "two run directories, or two maps, the older one first"
        )
    if told.places != checksum_of(before.under(PLACES)):
        raise DamagedError(f"{before.under(PLACES).address} is damaged, its checksum does not fit")
    return told, places_in(before)


def places_in(folder: Files) -> pd.DataFrame:
    """The places of a report, a row each."""
    rows = pd.read_parquet(io.BytesIO(folder.under(PLACES).read()))
    return rows.drop(columns="geometry", errors="ignore")


def _hash(settings: RunSettings) -> str:
    making: dict[str, Any] = making_of(settings)
    return hash_of(making, settings.model, settings.spacing)
