"""The commands along routes and drives: measure errors, compute factors, compare sensors."""

from pathlib import Path
from typing import Annotated, Any

import typer

from tilestream.apps import compare as comparing
from tilestream.cli.cluster import HERE, Cluster, on_cluster
from tilestream.cli.options import (
    AsJson,
    CellSize,
    DryRun,
    Every,
    FromS,
    Matcher,
    Memory,
    Offset,
    PointsTopic,
    PoseTopic,
    ProjectTo,
    Routes,
    SensorHeight,
    Spacing,
    StoreUrl,
    UntilS,
    matcher_of,
    numbers,
    parse_bytes,
    routes_of,
    sensor_of,
)
from tilestream.cli.printing import out, print_json, say
from tilestream.cli.progress import progress
from tilestream.cli.tables import (
    comparison_table,
    error_facts,
    error_table,
    factor_table,
    plan_table,
)
from tilestream.errors import PartialError
from tilestream.factors.catalogue import Which
from tilestream.factors.rows import samples_by_tile
from tilestream.factors.virtual_scan import VirtualSettings
from tilestream.formats.logs import ScanSelection
from tilestream.pipeline.jobs import along_routes
from tilestream.pipeline.jobs import localize as localize_drive
from tilestream.pipeline.stages.drive_scans import Reading
from tilestream.pipeline.stages.factors import Looking
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.records import TruePose
from tilestream.report import write_comparison
from tilestream.report.segments import check_threshold
from tilestream.sensor import SENSORS
from tilestream.settings import StartSettings
from tilestream.store import open_store


@on_cluster
def localize(
    store: StoreUrl,
    log: Annotated[str, typer.Argument(help="An MCAP log with point clouds and poses.")],
    folder: Annotated[str, typer.Option("--out", help="Folder of the tables.")],
    cell_size: CellSize = 2.0,
    spacing: Spacing = 1.0,
    matcher: Matcher = "default",
    scan_leaf: Annotated[float, typer.Option(help="Thin scans to one point per voxel [m].")] = 2.0,
    radius: Annotated[float, typer.Option(help="Radius of the disc of starts [m].")] = 2.0,
    step: Annotated[float, typer.Option(help="Spacing of the starts [m].")] = 0.2,
    true_pose: Annotated[TruePose, typer.Option(help="As in the log, or refined.")] = "log",
    beams: Annotated[int | None, typer.Option(help="As if by a lidar of n beams.")] = None,
    max_range: Annotated[float | None, typer.Option(help="As if by one of this range [m].")] = None,
    blind_rear: Annotated[float | None, typer.Option(help="As if blind at the rear [deg].")] = None,
    deskew: Annotated[
        bool, typer.Option("--deskew", help="Remove the motion's distortion.")
    ] = False,
    sweep: Annotated[
        float | None, typer.Option(help="Duration of a turn [s], if no times.")
    ] = None,
    points_topic: PointsTopic = None,
    pose_topic: PoseTopic = None,
    every: Every = 1,
    offset: Offset = 0,
    from_s: FromS = 0.0,
    until_s: UntilS = None,
    starts_per_task: Annotated[
        int | None, typer.Option(help="Split the starts; default: no.")
    ] = None,
    memory: Memory = "1.5GB",
    dry_run: DryRun = False,
    as_json: AsJson = False,
    cluster: Cluster = HERE,
) -> None:
    """Measure the localization error along a drive: 317 registrations per sample point."""
    allowed = parse_bytes(memory)
    how: dict[str, Any] = {
        "cell_size": cell_size,
        "spacing": spacing,
        "registration": matcher_of(matcher, scan_leaf=scan_leaf),
        "starts": StartSettings(radius=radius, step=step),
        "true_pose": true_pose,
        "scans": ScanSelection(every=every, offset=offset, from_s=from_s, until_s=until_s),
        "starts_per_task": starts_per_task,
        "memory": allowed,
    }
    reading = Reading(
        log, points_topic, pose_topic, beams, max_range, blind_rear, deskew or bool(sweep), sweep
    )
    opened = open_store(store)
    if dry_run:
        out.print(
            plan_table(
                localize_drive.plan_localize(MapPlan.of_store(opened), reading, folder, **how)
            )
        )
        return
    with cluster.client(allowed) as client, progress() as watch:
        labels = localize_drive.localize(
            opened, log, folder, **how, reading=reading, client=client, watch=watch
        )
    done = labels[labels["status"] == "done"]
    if as_json:
        print_json(error_facts(labels))
    else:
        out.print(error_table(labels))
        say(f"The tables are in {folder}/errors and {folder}/starts")
    if len(done) < len(labels):
        failed = labels[labels["status"] == "failed"]
        reasons = {f"scan {s}": r for s, r in zip(failed["scan"], failed["reason"], strict=True)}
        raise PartialError(f"{log}: {len(failed)} of {len(labels)} scans failed:", reasons)


@on_cluster
def factors(
    store: StoreUrl,
    route: Routes,
    folder: Annotated[str, typer.Option("--out", help="Folder of the tables.")],
    spacing: Spacing = 1.0,
    sensor: Annotated[str, typer.Option(help=f"{', '.join(SENSORS)}, or a YAML file.")] = "VLP16",
    sensor_height: SensorHeight = 2.0,
    cell_size: CellSize = 2.0,
    which: Annotated[Which, typer.Option(help="The paper's 20, their robust twins.")] = "all",
    project_to: ProjectTo = None,
    memory: Memory = "1.5GB",
    dry_run: DryRun = False,
    as_json: AsJson = False,
    cluster: Cluster = HERE,
) -> None:
    """Compute the factors of the map at every sample point of a route."""
    allowed, opened = parse_bytes(memory), open_store(store)
    routes = routes_of(route, project_to)
    seen_by = sensor_of(sensor)
    if dry_run:
        looking = Looking(seen_by, cell_size, which, sensor_height)
        samples = samples_by_tile(opened.grid, routes, spacing)
        plan = along_routes.plan_factors(
            MapPlan.of_store(opened), samples, folder, looking, allowed
        )
        out.print(plan_table(plan))
        return
    with cluster.client(allowed) as client, progress() as watch:
        rows = along_routes.factors_along(
            opened,
            routes,
            folder,
            spacing=spacing,
            sensor=seen_by,
            sensor_height=sensor_height,
            cell_size=cell_size,
            which=which,
            client=client,
            memory=allowed,
            watch=watch,
        )
    counts = rows["status"].value_counts()
    if as_json:
        print_json({"sample_points": len(rows), **{str(k): int(v) for k, v in counts.items()}})
    else:
        out.print(factor_table(rows))
        say(f"The tables are in {folder}/factors")
    if counts.get("done", 0) < len(rows):
        bad = rows[rows["status"] != "done"].groupby("reason").size()
        reasons = {str(reason): f"{count} sample points" for reason, count in bad.items()}
        raise PartialError(f"{store}: not every sample point has factors:", reasons)


@on_cluster
def compare(
    store: StoreUrl,
    route: Routes,
    folder: Annotated[str, typer.Option("--out", help="Folder of the page and the tables.")],
    sensor: Annotated[
        list[str], typer.Option(help=f"{', '.join(SENSORS)}, or a YAML file; several times.")
    ] = ["VLP16"],  # noqa: B006 - as below: typer's way to name a default
    cell_size: Annotated[
        list[str], typer.Option(help="Edges of the NDT cells [m], e.g. 1.0,2.0.")
    ] = ["2.0"],  # noqa: B006
    ranges: Annotated[
        list[str], typer.Option("--range", help="Usable ranges [m], e.g. 30,60; default: all.")
    ] = [],  # noqa: B006
    blind_rear: Annotated[
        list[str], typer.Option(help="Blind sectors at the rear [deg], e.g. 0,120.")
    ] = ["0"],  # noqa: B006
    matcher: Matcher = "default",
    spacing: Spacing = comparing.SPACING,
    cap: Annotated[
        float, typer.Option(help="What 95 % of a tile's estimates must stay within [m].")
    ] = 0.15,
    threshold: Annotated[float, typer.Option(help="Estimates above are too large [m].")] = 0.25,
    sensor_height: SensorHeight = 2.0,
    project_to: ProjectTo = None,
    memory: Memory = "1.5GB",
    dry_run: DryRun = False,
    as_json: AsJson = False,
    cluster: Cluster = HERE,
) -> None:
    """Compare lidars, ranges and map resolutions along routes, from the map alone."""
    for limit in (threshold, cap):
        check_threshold(limit)
    allowed, opened = parse_bytes(memory), open_store(store)
    routes = routes_of(route, project_to)
    choices = comparing.choices_of(
        [sensor_of(name) for name in sensor],
        numbers(ranges, "--range") or (None,),
        numbers(blind_rear, "--blind-rear"),
        numbers(cell_size, "--cell-size"),
    )
    registration = matcher_of(matcher)
    if dry_run:
        how = (spacing, registration, sensor_height, VirtualSettings(), allowed)
        out.print(plan_table(comparing.plan_compare(opened, routes, folder, choices, *how)))
        return
    with cluster.client(allowed) as client, progress() as watch:
        found = comparing.compare(
            opened,
            routes,
            folder,
            choices,
            spacing=spacing,
            registration=registration,
            sensor_height=sensor_height,
            client=client,
            memory=allowed,
            watch=watch,
        )
    content = write_comparison(found, folder, threshold=threshold, cap=cap)
    if as_json:
        print_json(content)
    else:
        out.print(comparison_table(content))
        say(f"The page is at {(Path(folder) / 'compare.html').absolute()}")
    if not any(choice["estimated"] for choice in content["choices"]):
        reasons = content["choices"][0]["missing"]
        failures = {str(reason): f"{count} sample points" for reason, count in reasons.items()}
        raise PartialError(f"{store}: no sample point has an estimate:", failures)
