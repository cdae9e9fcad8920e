"""The commands of whole jobs: the main job, its plan, the simulation, the demo."""

import io
import json
from typing import Annotated, Any

import pandas as pd
import typer

from tilestream.apps import diff as map_diff
from tilestream.apps import verbs
from tilestream.apps.warm import warm as compile_kernels
from tilestream.cli.cluster import ALL_CORES, HERE, AllCores, Cluster, on_cluster
from tilestream.cli.fields import fields, options_named, with_settings
from tilestream.cli.options import AsJson, Changes, Config, DryRun
from tilestream.cli.plans import forecast_table, plan_table
from tilestream.cli.printing import err, out, print_json, say, say_notes, show_worth
from tilestream.cli.progress import progress
from tilestream.cli.tables import report_table
from tilestream.counts import count_of
from tilestream.errors import LimitError, PartialError, StoreError, UsageError
from tilestream.files import Files
from tilestream.pipeline.jobs import run as main_job
from tilestream.pipeline.jobs import simulate as simulation
from tilestream.pipeline.jobs.estimate import OUT, coarse_settings, estimate_settings
from tilestream.pipeline.jobs.forecast import forecast
from tilestream.pipeline.jobs.run_book import told_before
from tilestream.pipeline.jobs.run_inputs import check_files, extent, simulations
from tilestream.pipeline.jobs.run_names import RECORD
from tilestream.pipeline.jobs.run_settings import RunSettings, read_settings
from tilestream.pipeline.stages.simulated import SCENE_BYTES
from tilestream.records import District
from tilestream.report import cards, gate
from tilestream.report.data import interpolated
from tilestream.report.drives import EVALUATED, DriveMeasured
from tilestream.report.formatting import cm_limit, distance
from tilestream.report.gate import GateSettings, Over
from tilestream.report.measured import Measured
from tilestream.report.summary import reasons_told
from tilestream.settings import (
    CoarseSettings,
    LabelSettings,
    LogSettings,
    MapSettings,
    PlaceSettings,
    ReportSettings,
    SimulateSettings,
    VirtualSettings,
)
from tilestream.simulation.settings import SimulationSettings


def template() -> None:
    """Print a job for your city: a YAML file that explains every setting."""
    out.out(verbs.template(), end="", highlight=False)


COARSE = CoarseSettings()
GATE = fields("fail_over", "measure", "over")


@on_cluster
@with_settings
def estimate(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="MAP",
            help="Files, globs, a map directory, logs of a survey; or a tile store alone.",
        ),
    ],
    places: Annotated[
        PlaceSettings,
        fields(
            *("sensor", "sensor_height", "spacing", "project_to", "route_z", "cell_size"),
            *("prediction_error", "memory"),
        ),
    ],
    seeing: Annotated[VirtualSettings, fields("range_max", "blind_rear_deg")],
    labels: Annotated[LabelSettings, fields("matcher")],
    which_map: Annotated[MapSettings, fields("crs", "partial", *LogSettings.model_fields)],
    report: Annotated[ReportSettings, fields("threshold", "title", "own_range")],
    gate_of: Annotated[GateSettings, GATE],
    route: Annotated[
        list[str],
        typer.Option(
            help="TUM, KITTI, CSV, GeoJSON, Lanelet2 or a log; several times; default: all lanes "
            "of the map, else the way of the logs that it is made of."
        ),
    ] = [],  # noqa: B006 - typer's way to say none
    model: Annotated[
        str | None,
        typer.Option(
            help="A model file; shipped: the one that comes with tilestream; physics: the virtual "
            "drive as it is.",
            show_default="shipped, where one is",
        ),
    ] = None,
    coarse: Annotated[
        int | None,
        typer.Option(
            help="Evaluate about one place in so many first, others only where errors are high or "
            "change fast, and interpolate the rest; not given: all."
        ),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="With --coarse: how far off an interpolated estimate may be [m]; a check tells "
            "how often it is more.",
            show_default=f"{COARSE.tolerance}",
        ),
    ] = None,
    folder: Annotated[str, typer.Option("--out", help="The run directory.")] = OUT,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="As `plan`.")] = False,
    as_json: AsJson = False,
    cluster: Cluster = ALL_CORES,
) -> None:
    """From a map alone to the localization error everywhere: nobody has to drive there first.

    - `tilestream estimate map/`: all lanes of a map directory of Autoware

    - `tilestream estimate map.laz --route route.geojson --sensor HDL64 --sensor-height 1.73`

    - `tilestream estimate drive.mcap --every 2`: the streets of a survey, from its log

    - `tilestream estimate map.zarr --route lanelet2_map.osm --fail-over 0.25`: a gate

    It ends by printing what the estimates are worth, the headline, and where the report is. The
    same command continues a job that was stopped. `tilestream run` learns from drives too.
    """
    with options_named({"out": "--out", "every": "--coarse", "tolerance": "--tolerance"}):
        settings = estimate_settings(
            sources,
            route,
            folder,
            model,
            places,
            seeing,
            labels,
            which_map,
            report,
            coarse_settings(coarse, tolerance),
        )
    if dry_run:
        show_plan(settings, as_json)
    else:
        do_and_tell(settings, cluster, gate_of, as_json)


@on_cluster
@with_settings
def run(
    config: Config,
    gate_of: Annotated[GateSettings, GATE],
    changes: Changes = [],  # noqa: B006
    dry_run: Annotated[bool, typer.Option("--dry-run", help="As `plan`.")] = False,
    as_json: AsJson = False,
    cluster: Cluster = ALL_CORES,
) -> None:
    """The main job: from map and drives to the estimated error everywhere, and its report."""
    settings = read_settings(config, changes)
    if dry_run:
        show_plan(settings, as_json)
    else:
        do_and_tell(settings, cluster, gate_of, as_json)


def do_and_tell(
    settings: RunSettings, cluster: Cluster, gate_of: GateSettings, as_json: bool
) -> None:
    """Run the main job, print its headline, and close the gate where one is asked for.

    What failed is told after the headline of what is done, and what the gate says of that.

    Raises:
        PartialError: some of the work failed; lists it.
        LimitError: the gate is closed.
    """
    failed: PartialError | None = None
    try:
        folder = do_job(settings, cluster)
    except PartialError as error:
        folder, failed = settings.folder, error
        if "report" not in told_before(folder.under(RECORD)):  # of this call there is none
            raise
    update = told_before(folder.under(RECORD)).get("update")
    if as_json:
        print_json({**report_of(folder), "update": update})
    else:
        show_report(folder)
        if update is not None:
            show_update(folder, update)
    try:
        if gate_of.fail_over is not None:
            require_within(folder, gate_of.fail_over, gate_of.measure, gate_of.over)
    except LimitError as error:
        if failed is None:
            raise
        say(f"the gate is closed: {error}", to=err)
    if failed is not None:
        raise failed


def do_job(settings: RunSettings, cluster: Cluster) -> Files:
    """Run the main job with progress; the run directory. Files that are not there are told before
    workers are started.
    """
    check_files(settings)
    with cluster.client(settings.memory) as client, progress() as watch:
        return Files.at(main_job.run(settings, client, watch))


def report_of(folder: Files) -> dict[str, Any]:
    """The figures of a run's report."""
    found: dict[str, Any] = json.loads(folder.under("report/report.json").read())
    return found


def show_report(folder: Files) -> None:
    """Print what the estimates of a report are worth, its headline and where it is."""
    report = report_of(folder)
    show_worth(report["worth"])
    out.print(report_table(report, cards(report)))
    say(f"The matcher is {report['facts']['matcher']['name']}")
    for line in [*not_estimated(report), *hardly_measured(report), *lost_labels(report)]:
        say(line)
    say_notes(report["notes"])
    say(f"The report is at {folder.under('report/index.html').address}")


def show_update(folder: Files, update: dict[str, Any]) -> None:
    """Print what an update of the map reached, and how much road got worse by it."""
    say(update["told"])
    try:
        found = map_diff.diff(folder.address)
    except (UsageError, StoreError):  # of an older version: nothing is kept of before
        return
    places, road = count_of(len(found.worse), "place"), float(found.worse["length"].sum())
    why = f": `tilestream diff {folder.address}` says where and why" if len(found.worse) else ""
    say(f"{places}, {distance(road)} of road, got worse by more than {cm_limit(found.limit)}{why}")


def not_estimated(report: dict[str, Any]) -> list[str]:
    """A line on the places without an estimate, and why; none: all have one."""
    head = report["headline"]
    if not head["missing"]:
        return []
    why = reasons_told(head["missing_by_reason"])
    return [f"{head['missing']:,} of {head['places']:,} places have no estimate: {why}"]


def hardly_measured(report: dict[str, Any]) -> list[str]:
    """A line on each drive of which most scans were not measured, and why."""
    drives = [
        DriveMeasured(**{name: value for name, value in drive.items() if name != "evaluated"})
        for drive in report["drives"]
    ]
    return [
        f"{drive.drive}: {drive}" for drive in drives if drive.measured < EVALUATED * drive.scans
    ]


def lost_labels(report: dict[str, Any]) -> list[str]:
    """A line on the measured places that no model could learn from, and one for each reason; none:
    nothing.
    """
    lost = report["lost_labels"]
    if not lost:
        return []
    total = sum(one["count"] for one in lost)
    of = total + report["headline"]["labelled"]
    reasons = [
        f"  {one['count']:,} {one['reason']}"
        + (f": {one['detail']}" if one["detail"] else "")
        + (f"; would be kept by {one['kept_by']}" if one.get("kept_by") else "")
        for one in lost
    ]
    return [f"{total:,} of {count_of(of, 'measured place')} not used:", *reasons]


def require_within(
    folder: Files, limit: float, measure: Measured = "mean", over: Over = "places"
) -> None:
    """Fail where the error exceeds a limit, or is not known: a gate for a map release.

    Raises:
        LimitError: the gate is closed; says why (`gate`).
    """
    table = io.BytesIO(folder.under("report/places.parquet").read())
    places = pd.read_parquet(table)
    missing = int(places["estimate"].isna().sum())
    between = int(interpolated(places).sum())
    told = f"; {between:,} are interpolated, not evaluated" if between else ""
    say(f"{missing:,} of {count_of(len(places), 'sample point')} without an estimate{told}", to=err)
    closed = gate(places, limit, report_of(folder)["drives"], measure, over)
    if closed:
        raise LimitError("; ".join(closed))


def plan(
    config: Config,
    changes: Changes = [],  # noqa: B006
    as_json: AsJson = False,
) -> None:
    """What a job would run: stages, tasks, memory, core-hours; reads headers, writes nothing."""
    show_plan(read_settings(config, changes), as_json)


def show_plan(settings: RunSettings, as_json: bool) -> None:
    """Print what a job would run."""
    expected = forecast(settings)
    rows = verbs.stage_rows(expected.tasks)
    if as_json:
        print_json({"stages": rows, "update": expected.update, "notes": expected.notes})
        return
    out.print(forecast_table(rows))
    if expected.update is not None:
        say(expected.update["told"])
    say_notes(expected.notes, to=out)


@on_cluster
@with_settings
def simulate(
    city: Annotated[District, typer.Argument(help="A district that ships with us.")],
    folder: Annotated[str, typer.Option("--out", help="Folder of map, logs and routes.")],
    what: Annotated[
        SimulateSettings, fields("preset", "scans_per_point", "every", "survey_of", "seed", "size")
    ],
    day: Annotated[SimulationSettings, fields("drive")],
    paths: Annotated[str | None, typer.Option(help="Only these, e.g. I,III; default: all.")] = None,
    dry_run: DryRun = False,
    cluster: Cluster = HERE,
) -> None:
    """Simulate a survey of a district and drives through it; a killed run continues."""
    where = what.model_copy(update={"city": city, "drives": day.drive + 1})
    settings = simulations(where)[day.drive]
    wanted = extent(what) | {"paths": paths.split(",") if paths else None}
    if dry_run:
        out.print(plan_table(simulation.plan_simulation(settings, folder, **wanted)))
        return
    with cluster.client(SCENE_BYTES) as client, progress() as watch:
        made = simulation.simulate(settings, folder, **wanted, client=client, watch=watch)
    say(f"{city}, preset {settings.preset}: {settings.note}")
    say(f"The map is in {made}/survey, the drives are in {made}/logs")


def demo(
    folder: Annotated[str, typer.Option("--out", help="The run directory.")] = "tilestream-demo",
    workers: AllCores = None,
) -> None:
    """A street of Shinjuku from its map alone, and what a drive measures: minutes, no files."""
    show_report(do_job(verbs.demo_settings(folder), Cluster(workers=workers)))


def warm() -> None:
    """Compile the kernels that jobs need: once per installation, for an image or a first job."""
    out.print("Compiling, once per installation: about a minute of one core.", highlight=False)
    folder = compile_kernels()
    told = f"The kernels are kept in {folder}" if folder else "No folder is safe to keep them in"
    out.print(told, soft_wrap=True, highlight=False)
