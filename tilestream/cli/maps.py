"""The commands about maps and files: make a tile store, look into one, compare two."""

from dataclasses import asdict
from typing import Annotated

import typer

from tilestream.apps import diff as map_diff
from tilestream.apps import verify as verifying
from tilestream.cli.cluster import HERE, Cluster, on_cluster
from tilestream.cli.fields import fields, with_settings
from tilestream.cli.options import AsJson, DryRun, StoreUrl
from tilestream.cli.printing import out, print_json, say
from tilestream.cli.progress import progress
from tilestream.cli.tables import TILE_CHANGES, diff_table, info_table, plan_table, tile_table
from tilestream.errors import PartialError
from tilestream.formats import describe
from tilestream.pipeline.jobs import ingest as ingest_map
from tilestream.pipeline.jobs.run_inputs import ingest_settings, scans_of
from tilestream.settings import IngestSettings, MapSettings, PlaceSettings
from tilestream.store import POINTS, TileStore, open_store

LOG_FIELDS = ("points_topic", "pose_topic", "every", "offset", "from_s", "until_s")
"""Which scans of a log are used, and where they are in it."""


@on_cluster
@with_settings
def ingest(
    sources: Annotated[
        list[str], typer.Argument(help="Files, globs, Autoware map directories, mixed.")
    ],
    store: Annotated[str, typer.Option(help="The tile store: a path or an fsspec URL.")],
    how: Annotated[MapSettings, fields(*IngestSettings.model_fields, *LOG_FIELDS)],
    limits: Annotated[PlaceSettings, fields("memory")],
    dry_run: DryRun = False,
    cluster: Cluster = HERE,
) -> None:
    """Make a tile store from point clouds, map directories and logs of drives."""
    settings, scans, allowed = ingest_settings(how), scans_of(how), limits.memory
    if dry_run:
        plan = ingest_map.plan_ingest(
            sources, store, settings, allowed, how.points_topic, how.pose_topic, scans
        )
        out.print(plan_table(plan))
        if plan.left_out:
            raise PartialError(f"{store}: sources that would be left out:", dict(plan.left_out))
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
                points_topic=how.points_topic,
                pose_topic=how.pose_topic,
                scans=scans,
            )
        except PartialError as error:
            failed = error
    made = open_store(store)
    print_sources(made)
    out.print(tile_table(made))
    if failed is not None:
        raise failed


def status(
    store: StoreUrl,
    as_json: AsJson = False,
) -> None:
    """Show the tiles of a store: counts, extents, status and reasons."""
    opened = open_store(store)
    marks = opened.marks(POINTS)
    failures = {f"tile {k}": m.reason for k, m in marks.items() if m.status == "failed"}
    failures |= {s["path"]: s["reason"] for s in opened.sources() if s["reason"]}
    condition = opened.condition()
    failures |= {} if condition.whole else {opened.url: str(condition)}
    if as_json:
        print_json(
            {
                "url": opened.url,
                "whole": condition.whole,
                "condition": str(condition),
                "settings": asdict(opened.settings),
                "sources": opened.sources(),
                "tiles": {str(key): asdict(mark) for key, mark in marks.items()},
            }
        )
    else:
        out.print(tile_table(opened))
        say(f"The map is {condition}")
    if failures:
        raise PartialError(f"{store}: the map is not whole, or parts of it failed:", failures)


def verify(
    place: Annotated[str, typer.Argument(help="A tile store, a run directory, or its tables.")],
    repair: Annotated[
        bool,
        typer.Option(
            "--repair",
            help="Remove what is damaged and can be made again, which the same command then does.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Read everything that is stored there; list what is damaged, half-made or lost."""
    read, left = verifying.verify(place)
    removed: list[verifying.Damage] = []
    if repair and left:
        removed, left = verifying.repair(place)
    if as_json:
        told = {"removed": removed, "damaged": left}
        lists = {name: [{"path": d.path, "reason": d.reason} for d in told[name]] for name in told}
        print_json({"read": read, **lists})
    else:
        for damage in removed:
            say(f"removed {damage.path}: {damage.reason}")
        if removed:
            say("Run the commands that made these again: they make them anew")
        say(f"{read - len(removed) - len(left):,} of {read:,} are as they were written")
    if left:
        reasons = {d.path: d.reason + _why_left(d) for d in left}
        raise PartialError(f"{place}: {len(left)} damaged, half-made or lost:", reasons)


def _why_left(damage: verifying.Damage) -> str:
    """Why something damaged cannot be removed, as far as that is not clear."""
    missing = verifying.gone(damage)
    return f"; made from {missing[0]}, which is gone" if missing else ""


def info(
    file: Annotated[str, typer.Argument(help="Any supported file, log or map directory.")],
    as_json: AsJson = False,
) -> None:
    """Show what is in a file or log: points, bounds, fields, topics, CRS."""
    found = describe(file)
    if as_json:
        print_json(asdict(found))
    else:
        out.print(info_table(found))


def diff(
    old: Annotated[str, typer.Argument(help="A run directory or tile store.")],
    new: Annotated[str, typer.Argument(help="The newer one.")],
    worse: Annotated[
        float, typer.Option(help="List estimates that grew by more [m].")
    ] = map_diff.WORSE,
    as_json: AsJson = False,
) -> None:
    """What a map update changes: tiles, and sample points whose estimate got worse."""
    found = map_diff.diff(old, new, worse=worse)
    if as_json:
        tiles = {kind: [str(k) for k in getattr(found, kind)] for kind in TILE_CHANGES}
        points = found.worse.to_dict("records")
        print_json({**tiles, "same": found.same, "compared": found.compared, "worse": points})
    else:
        out.print(diff_table(found))


def print_sources(store: TileStore) -> None:
    """What an ingest read, a line per source."""
    for source in store.sources():
        dropped = f", {source['dropped']:,} not finite and dropped" if source["dropped"] else ""
        say(f"{source['path']}: {source['format']}, {source['points']:,} points{dropped}")
        for note in source["notes"]:
            say(f"  {note}")
