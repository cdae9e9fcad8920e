"""The commands about maps: make a tile store, look into one, compare two."""

from dataclasses import asdict
from typing import Annotated, Any

import typer

from tilestream.apps import diff as map_diff
from tilestream.apps import verify as verifying
from tilestream.cli.cluster import HERE, Cluster, on_cluster
from tilestream.cli.fields import fields, with_settings
from tilestream.cli.options import AsJson, DryRun, StoreUrl
from tilestream.cli.printing import err, out, print_json, say, say_notes
from tilestream.cli.progress import progress
from tilestream.cli.tables import (
    diff_table,
    plan_table,
    stretch_table,
    tile_table,
)
from tilestream.errors import LimitError, PartialError
from tilestream.files import Files
from tilestream.pipeline.jobs import ingest as ingest_map
from tilestream.pipeline.jobs.map_expected import tiles_to_read
from tilestream.pipeline.jobs.map_update import Update, tiles_written
from tilestream.pipeline.jobs.run_inputs import ingest_settings, scans_of
from tilestream.pipeline.jobs.sources import map_notes
from tilestream.report import diff_gate, write_diff
from tilestream.report.diff.data import WORSE
from tilestream.report.diff.gate import DiffGateSettings
from tilestream.report.diff.summary import diff_content
from tilestream.settings import IngestSettings, LogSettings, MapSettings, PlaceSettings
from tilestream.store import POINTS, TileStore, open_store


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
        print_json(store_facts(opened))
    else:
        out.print(tile_table(opened))
        say(f"The map is {condition}")
        say_notes(map_notes(opened))
    if failures:
        raise PartialError(f"{store}: the map is not whole, or parts of it failed:", failures)


def store_facts(store: TileStore) -> dict[str, Any]:
    """A tile store for machines: its state, its tiles, and what was noticed of its sources."""
    condition = store.condition()
    ours = ("scans", "told")  # of each scan of a log, for nobody to read; what notes have too
    sources = [{k: v for k, v in one.items() if k not in ours} for one in store.sources()]
    return {
        "url": store.url,
        "whole": condition.whole,
        "condition": str(condition),
        "settings": asdict(store.settings),
        "sources": sources,
        "notes": map_notes(store),
        "tiles": {str(key): asdict(mark) for key, mark in store.marks(POINTS).items()},
    }


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


@with_settings
def diff(
    old: Annotated[str, typer.Argument(help="A run directory or tile store.")],
    gate_of: Annotated[DiffGateSettings, fields("fail_worse", "measure", "over")],
    new: Annotated[
        str | None,
        typer.Argument(
            help="The newer one.", show_default="the run as it is, after its last map update"
        ),
    ] = None,
    worse: Annotated[
        float, typer.Option(help="Estimates that grew by more than this are worse [m].")
    ] = WORSE,
    report: Annotated[
        str | None, typer.Option(help="Folder of a page of it, `diff.html`, and its figures.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """What a map update changes: tiles, and how much road got worse, where and why.

    - `tilestream diff old-run new-run --report changes`: a page, before and after on one map

    - `tilestream diff run --fail-worse 0.05`: a gate, on what the last update of its map changed
    """
    found = map_diff.diff(old, new, worse=worse)
    verdict = None
    if gate_of.fail_worse is not None:
        verdict = diff_gate(found, gate_of.fail_worse, gate_of.measure, gate_of.over)
    content = diff_content(found, verdict)
    if report is not None:
        write_diff(found, report, verdict)
    if as_json:
        print_json(content)
    else:
        out.print(diff_table(found))
        if len(found.places.stretches):
            out.print(stretch_table(found))
        say_notes(found.notes)
        if report is not None:
            say(f"The page is at {Files.at(report).under('diff.html').address}")
    if verdict is not None and not verdict.closed:
        say(verdict.told, to=err)
    if found.gone:
        raise PartialError(
            "no tiles are compared, estimates only; a map is gone:", dict(found.gone)
        )
    if verdict is not None and verdict.closed:
        raise LimitError(verdict.told)


def print_sources(store: TileStore) -> None:
    """What an ingest read, a line per source."""
    for source in store.sources():
        say(f"{source['path']}: {source['format']}, {source['points']:,} points")
        for line in source.get("contents", ()):  # older stores have none
            say(f"  {line}")
    say_notes(map_notes(store), to=out)
