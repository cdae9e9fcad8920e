"""The commands: parse, call, print. The only place that exits.

Exit codes: 0 all good; 1 some sources, tiles or scans failed and are listed, the rest is done;
2 usage, or a job that does not fit its memory or disk.
"""

import json
import logging
import sys
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
import typer
import yaml
from rich.console import Console
from rich.logging import RichHandler

from tilestream.cli.progress import err, progress
from tilestream.cli.tables import (
    TILE_CHANGES,
    comparison_table,
    diff_table,
    error_facts,
    error_table,
    factor_table,
    forecast_rows,
    forecast_table,
    info_table,
    plan_table,
    report_table,
    tile_table,
)
from tilestream.config import IngestSettings, RegistrationSettings, StartSettings
from tilestream.dataflow import ingest_map, main_job
from tilestream.dataflow.compare import SPACING, choices_of, plan_compare
from tilestream.dataflow.compare import compare as compare_choices
from tilestream.dataflow.factors_route import factors_along, plan_factors
from tilestream.dataflow.factors_tasks import Looking
from tilestream.dataflow.localize_drive import localize as localize_drive
from tilestream.dataflow.localize_drive import plan_localize
from tilestream.dataflow.localize_tasks import Reading
from tilestream.dataflow.main_plan import forecast
from tilestream.dataflow.map_diff import WORSE, diff
from tilestream.dataflow.run import dask_client
from tilestream.dataflow.run_settings import RunSettings, read_settings
from tilestream.dataflow.simulate import SCENE_BYTES
from tilestream.dataflow.simulate import simulate as simulate_city
from tilestream.dataflow.telling import page_url
from tilestream.errors import (
    LimitError,
    PartialError,
    PlanError,
    SourceNotFoundError,
    StoreNotFoundError,
    TilestreamError,
    UsageError,
)
from tilestream.factors.catalogue import Which
from tilestream.factors.rows import samples_by_tile
from tilestream.factors.virtual_scan import VirtualSettings
from tilestream.formats import describe
from tilestream.formats.mcap import ScanSelection
from tilestream.formats.routes import read_routes
from tilestream.records import TruePose
from tilestream.report import exceeds
from tilestream.report.comparison_page import write_comparison
from tilestream.report.judgement import check_threshold
from tilestream.sensors import SENSORS, Sensor
from tilestream.simulation.settings import load_preset
from tilestream.store import POINTS, TileStore, open_store
from tilestream.version import VERSION

app = typer.Typer(
    name="tilestream",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
out = Console()

Matcher = Literal["default", "autoware"]
SCHEDULER = typer.Option(help="Run on this Dask scheduler, e.g. tcp://10.0.0.1:8786.")
WORKERS = typer.Option(min=1, help="Worker processes on this machine; 1: this process.")
POINTS_TOPIC = typer.Option(help="Topic of the scans in a log; default: found by type.")
POSE_TOPIC = typer.Option(help="Topic of the poses in a log; default: found by type.")
EVERY = typer.Option(min=1, help="Use every n-th scan of a log …")
OFFSET = typer.Option(min=0, help="… from this one on: another offset uses other scans.")
FROM_S = typer.Option(help="Use the scans of a log from this time on [s after its first].")
UNTIL_S = typer.Option(help="Use the scans of a log before this time [s after its first].")
JOB_WORKERS = typer.Option(min=1, help="Worker processes; default: one per core; 1: none.")
MEMORY = typer.Option(help="What one task may use, e.g. 512MB or 2GB.")


@app.callback(invoke_without_command=True)
def root(
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    debug: Annotated[  # noqa: ARG001 - `run` takes it from anywhere on the line
        bool, typer.Option("--debug", help="With any command: show the traceback of an error.")
    ] = False,
) -> None:
    """The localization error of a LiDAR vehicle at every metre, from the map alone."""
    plain = RichHandler(console=err, show_time=False, show_level=False, show_path=False)
    logging.basicConfig(format="%(message)s", handlers=[plain])
    logging.getLogger("tilestream").setLevel(logging.INFO)
    if version:
        out.print(VERSION, highlight=False)
        raise typer.Exit


def parse_bytes(text: str) -> int:
    """`512MB` or `2GB` as bytes (powers of ten).

    Raises:
        UsageError: it is not of that form.
    """
    for unit, factor in (("KB", 10**3), ("MB", 10**6), ("GB", 10**9), ("TB", 10**12)):
        number = text.strip().upper().removesuffix(unit)
        if number != text.strip().upper():
            try:
                amount = int(float(number) * factor)
            except (ValueError, OverflowError):
                break
            if amount > 0:
                return amount
    raise UsageError(f"{text!r} is no amount of memory: give a form like 512MB or 2GB")


def print_sources(store: TileStore) -> None:
    """What an ingest read, a line per source."""
    for source in store.sources():
        dropped = f", {source['dropped']:,} not finite and dropped" if source["dropped"] else ""
        out.print(
            f"{source['path']}: {source['format']}, {source['points']:,} points{dropped}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
        for note in source["notes"]:
            out.print(f"  {note}", highlight=False, markup=False, soft_wrap=True)


@app.command()
def ingest(
    sources: Annotated[
        list[str], typer.Argument(help="Files, globs, Autoware map directories, mixed.")
    ],
    store: Annotated[str, typer.Option(help="The tile store: a path or an fsspec URL.")],
    tile_size: Annotated[float, typer.Option(help="Edge of a tile [m].")] = 100.0,
    halo: Annotated[float, typer.Option(help="What tasks read around a tile [m].")] = 10.0,
    map_leaf: Annotated[
        float, typer.Option(help="Thin to one point per voxel [m]; 0: keep.")
    ] = 0.2,
    crs: Annotated[str | None, typer.Option(help="CRS of the map, e.g. EPSG:6677.")] = None,
    points_topic: Annotated[str | None, POINTS_TOPIC] = None,
    pose_topic: Annotated[str | None, POSE_TOPIC] = None,
    every: Annotated[int, EVERY] = 1,
    offset: Annotated[int, OFFSET] = 0,
    from_s: Annotated[float, FROM_S] = 0.0,
    until_s: Annotated[float | None, UNTIL_S] = None,
    memory: Annotated[str, MEMORY] = "1GB",
    scheduler: Annotated[str | None, SCHEDULER] = None,
    workers: Annotated[int, WORKERS] = 1,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan, do nothing.")] = False,
) -> None:
    """Make a tile store from point clouds, map directories and logs of drives."""
    settings = IngestSettings(tile_size=tile_size, halo=halo, map_leaf=map_leaf, crs=crs)
    allowed = parse_bytes(memory)
    scans = ScanSelection(every=every, offset=offset, from_s=from_s, until_s=until_s)
    if dry_run:
        plan = ingest_map.plan_ingest(
            sources, store, settings, allowed, points_topic, pose_topic, scans
        )
        out.print(plan_table(plan))
        return
    failed: PartialError | None = None
    with dask_client(scheduler, workers, allowed) as client, progress() as watch:
        try:
            ingest_map.ingest(
                sources,
                store,
                **settings.model_dump(),
                client=client,
                memory=allowed,
                watch=watch,
                points_topic=points_topic,
                pose_topic=pose_topic,
                scans=scans,
            )
        except PartialError as error:
            failed = error
    made = open_store(store)
    print_sources(made)
    out.print(tile_table(made))
    if failed is not None:
        raise failed


@app.command()
def status(
    store: Annotated[str, typer.Argument(help="The tile store.")],
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Show the tiles of a store: counts, extents, status and reasons."""
    opened = open_store(store)
    marks = opened.marks(POINTS)
    failures = {f"tile {k}": m.reason for k, m in marks.items() if m.status == "failed"}
    failures |= {s["path"]: s["reason"] for s in opened.sources() if s["reason"]}
    if as_json:
        print_json(
            {
                "url": opened.url,
                "settings": asdict(opened.settings),
                "sources": opened.sources(),
                "tiles": {str(key): asdict(mark) for key, mark in marks.items()},
            }
        )
    else:
        out.print(tile_table(opened))
    if failures:
        raise PartialError(f"{store}: {len(failures)} sources or tiles failed:", failures)


@app.command()
def info(
    file: Annotated[str, typer.Argument(help="Any supported file, log or map directory.")],
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Show what is in a file or log: points, bounds, fields, topics, CRS."""
    found = describe(file)
    if as_json:
        print_json(asdict(found))
    else:
        out.print(info_table(found))


@app.command()
def localize(
    store: Annotated[str, typer.Argument(help="The tile store.")],
    log: Annotated[str, typer.Argument(help="An MCAP log with point clouds and poses.")],
    folder: Annotated[str, typer.Option("--out", help="Folder of the tables.")],
    cell_size: Annotated[float, typer.Option(help="Edge of an NDT cell [m].")] = 2.0,
    spacing: Annotated[float, typer.Option(help="Distance between sample points [m].")] = 1.0,
    matcher: Annotated[Matcher, typer.Option(help="Ours, or the production matcher.")] = "default",
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
    points_topic: Annotated[str | None, POINTS_TOPIC] = None,
    pose_topic: Annotated[str | None, POSE_TOPIC] = None,
    every: Annotated[int, EVERY] = 1,
    offset: Annotated[int, OFFSET] = 0,
    from_s: Annotated[float, FROM_S] = 0.0,
    until_s: Annotated[float | None, UNTIL_S] = None,
    starts_per_task: Annotated[
        int | None, typer.Option(help="Split the starts; default: no.")
    ] = None,
    memory: Annotated[str, MEMORY] = "1GB",
    scheduler: Annotated[str | None, SCHEDULER] = None,
    workers: Annotated[int, WORKERS] = 1,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan, do nothing.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Measure the localization error along a drive: 317 registrations per sample point."""
    allowed = parse_bytes(memory)
    preset = RegistrationSettings.autoware if matcher == "autoware" else RegistrationSettings
    how: dict[str, Any] = {
        "cell_size": cell_size,
        "spacing": spacing,
        "registration": preset(scan_leaf=scan_leaf),
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
        out.print(plan_table(plan_localize(opened, reading, folder, **how)))
        return
    with dask_client(scheduler, workers, allowed) as client, progress() as watch:
        labels = localize_drive(
            opened, log, folder, **how, reading=reading, client=client, watch=watch
        )
    done = labels[labels["status"] == "done"]
    if as_json:
        print_json(error_facts(labels))
    else:
        out.print(error_table(labels))
        out.print(f"The tables are in {folder}/errors and {folder}/starts", highlight=False)
    if len(done) < len(labels):
        failed = labels[labels["status"] == "failed"]
        reasons = {f"scan {s}": r for s, r in zip(failed["scan"], failed["reason"], strict=True)}
        raise PartialError(f"{log}: {len(failed)} of {len(labels)} scans failed:", reasons)


@app.command()
def factors(
    store: Annotated[str, typer.Argument(help="The tile store.")],
    route: Annotated[list[str], typer.Option(help="TUM, KITTI, CSV, GeoJSON, Lanelet2 or MCAP.")],
    folder: Annotated[str, typer.Option("--out", help="Folder of the tables.")],
    spacing: Annotated[float, typer.Option(help="Distance between sample points [m].")] = 1.0,
    sensor: Annotated[str, typer.Option(help=f"{', '.join(SENSORS)}, or a YAML file.")] = "VLP16",
    sensor_height: Annotated[float, typer.Option(help="Of the lidar above the road [m].")] = 2.0,
    cell_size: Annotated[float, typer.Option(help="Edge of an NDT cell [m].")] = 2.0,
    which: Annotated[Which, typer.Option(help="The paper's 20, their robust twins.")] = "all",
    project_to: Annotated[str | None, typer.Option(help="CRS for routes in degrees.")] = None,
    memory: Annotated[str, MEMORY] = "1GB",
    scheduler: Annotated[str | None, SCHEDULER] = None,
    workers: Annotated[int, WORKERS] = 1,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan, do nothing.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Compute the factors of the map at every sample point of a route."""
    allowed, opened = parse_bytes(memory), open_store(store)
    routes = [found for path in route for found in read_routes(path, project_to=project_to)]
    seen_by = sensor_of(sensor)
    if dry_run:
        looking = Looking(seen_by, cell_size, which, sensor_height)
        samples = samples_by_tile(opened.grid, routes, spacing)
        out.print(plan_table(plan_factors(opened, samples, folder, looking, allowed)))
        return
    with dask_client(scheduler, workers, allowed) as client, progress() as watch:
        rows = factors_along(
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
        out.print(f"The tables are in {folder}/factors", highlight=False)
    if counts.get("done", 0) < len(rows):
        bad = rows[rows["status"] != "done"].groupby("reason").size()
        reasons = {str(reason): f"{count} sample points" for reason, count in bad.items()}
        raise PartialError(f"{store}: not every sample point has factors:", reasons)


@app.command()
def compare(
    store: Annotated[str, typer.Argument(help="The tile store.")],
    route: Annotated[list[str], typer.Option(help="TUM, KITTI, CSV, GeoJSON, Lanelet2 or MCAP.")],
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
    matcher: Annotated[Matcher, typer.Option(help="Ours, or the production matcher.")] = "default",
    spacing: Annotated[float, typer.Option(help="Between sample points [m].")] = SPACING,
    cap: Annotated[
        float, typer.Option(help="What 95 % of a tile's estimates must stay within [m].")
    ] = 0.15,
    threshold: Annotated[float, typer.Option(help="Estimates above are too large [m].")] = 0.25,
    sensor_height: Annotated[float, typer.Option(help="Of the lidar above the road [m].")] = 2.0,
    project_to: Annotated[str | None, typer.Option(help="CRS for routes in degrees.")] = None,
    memory: Annotated[str, MEMORY] = "1GB",
    scheduler: Annotated[str | None, SCHEDULER] = None,
    workers: Annotated[int, WORKERS] = 1,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan, do nothing.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """Compare lidars, ranges and map resolutions along routes, from the map alone."""
    for limit in (threshold, cap):
        check_threshold(limit)
    allowed, opened = parse_bytes(memory), open_store(store)
    routes = [found for path in route for found in read_routes(path, project_to=project_to)]
    choices = choices_of(
        [sensor_of(name) for name in sensor],
        numbers(ranges, "--range") or (None,),
        numbers(blind_rear, "--blind-rear"),
        numbers(cell_size, "--cell-size"),
    )
    preset = RegistrationSettings.autoware if matcher == "autoware" else RegistrationSettings
    if dry_run:
        how = (spacing, preset(), sensor_height, VirtualSettings(), allowed)
        out.print(plan_table(plan_compare(opened, routes, folder, choices, *how)))
        return
    with dask_client(scheduler, workers, allowed) as client, progress() as watch:
        found = compare_choices(
            opened,
            routes,
            folder,
            choices,
            spacing=spacing,
            registration=preset(),
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
        page = (Path(folder) / "compare.html").absolute()
        out.print(f"The page is at {page}", highlight=False, soft_wrap=True)
    if not any(choice["estimated"] for choice in content["choices"]):
        reasons = content["choices"][0]["missing"]
        failures = {str(reason): f"{count} sample points" for reason, count in reasons.items()}
        raise PartialError(f"{store}: no sample point has an estimate:", failures)


def numbers(lists: list[str], option: str) -> list[float]:
    """The numbers of an option that takes several, also with commas between them.

    Raises:
        UsageError: one is no number.
    """
    parts = [part.strip() for text in lists for part in text.split(",")]
    try:
        return [float(part) for part in parts]
    except ValueError:
        told = ", ".join(lists)
        raise UsageError(f"{option} {told}: give numbers, with commas between them") from None


def sensor_of(name: str) -> Sensor:
    """A sensor by its name, or from a YAML file; raises as `read_sensor`."""
    return SENSORS[name] if name in SENSORS else read_sensor(name)


def read_sensor(path: str) -> Sensor:
    """A sensor from a YAML file with the fields of `tilestream.Sensor`.

    Raises:
        UsageError: no such file or sensor, no mapping of fields, a field that cannot be.
    """
    if not Path(path).is_file():
        raise UsageError(f"{path}: no such sensor or file; known are {', '.join(SENSORS)}")
    try:
        fields = yaml.safe_load(Path(path).read_text())
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UsageError(f"{path}: no YAML: {error}") from None
    if not isinstance(fields, dict):
        raise UsageError(f"{path}: give the fields of a sensor, e.g. range_max: 100.0")
    return Sensor(**fields)


@app.command()
def simulate(
    city: Annotated[Literal["shinjuku"], typer.Argument(help="The city that ships with us.")],
    folder: Annotated[str, typer.Option("--out", help="Folder of map, logs and routes.")],
    preset: Annotated[
        str, typer.Option(help="physical, paper, or your own YAML file.")
    ] = "physical",
    paths: Annotated[str | None, typer.Option(help="Only these, e.g. I,III; default: all.")] = None,
    scans_per_point: Annotated[int, typer.Option(help="Turns of the lidar per metre.")] = 1,
    seed: Annotated[int, typer.Option(help="Seed of everything.")] = 0,
    drive: Annotated[int, typer.Option(min=0, help="Another day: other traffic and noise.")] = 0,
    size: Annotated[Literal["full", "small"], typer.Option(help="small: 40 m per path.")] = "full",
    scheduler: Annotated[str | None, SCHEDULER] = None,
    workers: Annotated[int, WORKERS] = 1,
) -> None:
    """Simulate a survey of Shinjuku and drives through it; a killed run continues."""
    settings = load_preset(preset).model_copy(update={"seed": seed, "drive": drive})
    with dask_client(scheduler, workers, SCENE_BYTES) as client, progress() as watch:
        made = simulate_city(
            settings,
            folder,
            paths=paths.split(",") if paths else None,
            scans_per_point=scans_per_point,
            size=size,
            client=client,
            watch=watch,
        )
    out.print(f"{city}, preset {settings.preset}: {settings.note}", highlight=False)
    out.print(f"The map is in {made}/survey, the drives are in {made}/logs", highlight=False)


@app.command("run")
def run_job(
    config: Annotated[str, typer.Argument(help="A YAML file; pipelines/city.yaml explains it.")],
    changes: Annotated[
        list[str], typer.Option("--set", help="key=value over the file, e.g. model.seed=1.")
    ] = [],  # noqa: B006 - typer's way to say none
    scheduler: Annotated[str | None, SCHEDULER] = None,
    workers: Annotated[int | None, JOB_WORKERS] = None,
    fail_over: Annotated[
        float | None, typer.Option(help="Exit with 1 if any estimate is above this [m].")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="As `plan`.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """The main job: from map and drives to the estimated error everywhere, and its report."""
    if dry_run:
        plan_job(config, changes, as_json=as_json)
        return
    folder = do_job(read_settings(config, changes), scheduler, workers)
    if as_json:
        print_json(report_of(folder))
    else:
        show_report(folder)
    if fail_over is not None:
        judge_over(folder, fail_over)


def do_job(settings: RunSettings, scheduler: str | None, workers: int | None) -> Path:
    """Run the main job with progress; the run directory."""
    with dask_client(scheduler, workers, settings.memory) as client, progress() as watch:
        if client is not None:
            err.print(f"Watch it at {page_url(client)}", highlight=False, soft_wrap=True)
        return main_job.run(settings, client, watch)


def report_of(folder: Path) -> dict[str, Any]:
    """The figures of a run's report."""
    found: dict[str, Any] = json.loads((folder / "report" / "report.json").read_text())
    return found


def show_report(folder: Path) -> None:
    """Print the headline of a report and where it is."""
    out.print(report_table(report_of(folder)))
    page = (folder / "report" / "index.html").absolute()
    out.print(f"The report is at {page}", highlight=False, soft_wrap=True)


def judge_over(folder: Path, limit: float) -> None:
    """Fail where the estimated error is too large: a gate for a map release.

    Raises:
        LimitError: an estimate is above the limit; says how many and the worst.
    """
    places = pd.read_csv(folder / "report" / "places.csv")
    if exceeds(places, limit):
        over = places[places["estimate"] > limit].nlargest(1, "estimate")
        count = int((places["estimate"] > limit).sum())
        where = [
            f"{r.estimate:.2f} m on {r.route_id} at {r.arc_length:.0f} m" for r in over.itertuples()
        ]
        raise LimitError(
            f"{count} of {len(places)} sample points are estimated above {limit:g} m, the worst "
            f"{''.join(where)}"
        )


@app.command("plan")
def plan_job(
    config: Annotated[str, typer.Argument(help="A YAML file, as for `run`.")],
    changes: Annotated[list[str], typer.Option("--set", help="key=value over the file.")] = [],  # noqa: B006
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """What a job would run: stages, tasks, memory, core-hours; reads headers, writes nothing."""
    expected = forecast(read_settings(config, changes))
    rows = forecast_rows(expected)
    if as_json:
        print_json({"stages": rows, "notes": list(expected.notes)})
        return
    out.print(forecast_table(rows))
    for note in expected.notes:
        out.print(note, highlight=False, soft_wrap=True)


@app.command("diff")
def diff_maps(
    old: Annotated[str, typer.Argument(help="A run directory or tile store.")],
    new: Annotated[str, typer.Argument(help="The newer one.")],
    worse: Annotated[float, typer.Option(help="List estimates that grew by more [m].")] = WORSE,
    as_json: Annotated[bool, typer.Option("--json", help="For machines.")] = False,
) -> None:
    """What a map update changes: tiles, and sample points whose estimate got worse."""
    found = diff(old, new, worse=worse)
    if as_json:
        tiles = {kind: [str(k) for k in getattr(found, kind)] for kind in TILE_CHANGES}
        points = found.worse.to_dict("records")
        print_json({**tiles, "same": found.same, "compared": found.compared, "worse": points})
    else:
        out.print(diff_table(found))


@app.command()
def demo(
    folder: Annotated[str, typer.Option("--out", help="The run directory.")] = "tilestream-demo",
    workers: Annotated[int | None, JOB_WORKERS] = None,
) -> None:
    """The main job on a few streets of Shinjuku, simulated first: some minutes, no files needed."""
    with resources.as_file(resources.files("tilestream") / "data" / "demo.yaml") as path:
        settings = read_settings(path, [f"out={json.dumps(folder)}"])
    show_report(do_job(settings, None, workers))


def print_json(value: object) -> None:
    """One JSON document on stdout."""
    text = json.dumps(value, indent=2, sort_keys=True, default=str, allow_nan=False)
    sys.stdout.write(f"{text}\n")


def main() -> None:
    """The entry point: run a command, turn errors into one clear line and an exit code."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: list[str]) -> int:
    """Run a command line and return its exit code."""
    debug = "--debug" in arguments
    try:
        app(args=[a for a in arguments if a != "--debug"], prog_name="tilestream")
    except SystemExit as end:
        return int(end.code or 0)
    except (UsageError, SourceNotFoundError, StoreNotFoundError, PlanError) as error:
        return _report(error, debug, 2)
    except (TilestreamError, OSError) as error:
        return _report(error, debug, 1)
    return 0


def _report(error: Exception, debug: bool, code: int) -> int:
    if debug:
        err.print_exception()
    err.print(f"error: {error}", markup=False, highlight=False, soft_wrap=True)
    return code
