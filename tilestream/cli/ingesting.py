"""The command that makes a tile store; it works in this process, and imports little."""

from typing import Annotated

import typer

from tilestream.cli.cluster import HERE, Cluster, on_cluster
from tilestream.cli.fields import fields, with_settings
from tilestream.cli.options import AsJson, DryRun
from tilestream.cli.plans import plan_table
from tilestream.cli.printing import out, print_json, say, say_notes
from tilestream.cli.progress import progress
from tilestream.cli.state import store_facts, tile_table
from tilestream.counts import count_of
from tilestream.errors import PartialError
from tilestream.pipeline.jobs import ingest as ingest_map
from tilestream.pipeline.jobs.map_expected import tiles_to_read
from tilestream.pipeline.jobs.map_update import Update, tiles_written
from tilestream.pipeline.jobs.sources import ingest_settings, map_notes, scans_of
from tilestream.settings import IngestSettings, LogSettings, MapSettings, PlaceSettings
from tilestream.store import TileStore, open_store


@on_cluster
@with_settings
def ingest(
    sources: Annotated[
        list[str], typer.Argument(help="Files, globs, Autoware map directories, mixed.")
    ],
    store: Annotated[str, typer.Option(help="The tile store: a path or an fsspec URL.")],
    how: Annotated[MapSettings, fields(*IngestSettings.model_fields, *LogSettings.model_fields)],
    limits: Annotated[PlaceSettings, fields("memory")],
    dry_run: DryRun = False,
    as_json: AsJson = False,
    cluster: Cluster = HERE,
) -> None:
    """Make a tile store from point clouds, map directories and logs of drives."""
    settings, scans, allowed = ingest_settings(how), scans_of(how), limits.memory
    had = tiles_written(store)
    if dry_run:
        planned = ingest_map.plan_ingest(sources, store, settings, allowed, how.log_options, scans)
        points = planned.expected(tiles_to_read(planned)[0]).points
        update = Update.between(had, {key: tile.identity for key, tile in points.items()})
        out.print(plan_table(planned.scatters))
        if update is not None:
            say(update.facts(at_most=True)["told"])
        say_notes(planned.notes)
        if planned.left_out:
            raise PartialError(f"{store}: sources that would be left out:", planned.left_out)
        return
    failed: PartialError | None = None
    with cluster.client(allowed) as client, progress() as watch:
        try:
            ingest_map.ingest(
                sources,
                store,
                **settings.model_dump(),
                client=client,
                memory=allowed,
                watch=watch,
                log_options=how.log_options,
                scans=scans,
            )
        except PartialError as error:
            failed = error
    made = open_store(store)
    update = Update.between(had, tiles_written(store))
    if as_json:
        print_json({**store_facts(made), "update": None if update is None else update.facts()})
    else:
        print_sources(made)
        out.print(tile_table(made))
        if update is not None:
            say(update.facts()["told"])
    if failed is not None:
        raise failed


def print_sources(store: TileStore) -> None:
    """What an ingest read, a line per source."""
    for source in store.sources():
        say(f"{source['path']}: {source['format']}, {count_of(source['points'], 'point')}")
        for line in source.get("contents", ()):  # older stores have none
            say(f"  {line}")
    say_notes(map_notes(store), to=out)
