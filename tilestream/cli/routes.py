"""The commands along routes and drives: measure errors, compute factors, compare sensors."""

from dataclasses import replace
from typing import Annotated, Any

import pandas as pd
import typer

from tilestream.apps import compare as comparing
from tilestream.apps.choices import choices_of
from tilestream.cli.cluster import HERE, Cluster, on_cluster
from tilestream.cli.fields import STARTS, fields, flag, options_named, was_given, with_settings
from tilestream.cli.given_routes import routes_of
from tilestream.cli.options import AsJson, DryRun, Routes, StoreUrl, numbers
from tilestream.cli.plans import plan_table
from tilestream.cli.printing import out, print_json, say, say_notes, show_worth
from tilestream.cli.progress import progress
from tilestream.cli.tables import (
    comparison_table,
    error_facts,
    error_table,
    factor_table,
)
from tilestream.counts import count_of
from tilestream.errors import LimitError, PartialError
from tilestream.factors.catalogue import Which
from tilestream.factors.heights import notes_of_routes
from tilestream.files import Files
from tilestream.matcher import RegistrationSettings
from tilestream.notes import MATCHER, noticed
from tilestream.pipeline.jobs import along_routes
from tilestream.pipeline.jobs import localize as localize_drive
from tilestream.pipeline.jobs.drive_measured import drive_measured
from tilestream.pipeline.jobs.run_folder import map_of
from tilestream.pipeline.jobs.run_inputs import reading_of
from tilestream.pipeline.jobs.sources import map_notes, scans_of
from tilestream.pipeline.jobs.unfit import unfit
from tilestream.pipeline.stages.drive_scans import opened as opened_log
from tilestream.pipeline.stages.factors import Looking
from tilestream.pipeline.stages.map_plan import MapPlan
from tilestream.report import write_comparison
from tilestream.report.drives import EVALUATED, DriveMeasured
from tilestream.report.log_poses import note_of_log_poses
from tilestream.report.segments import check_threshold
from tilestream.sensor import SENSORS, sensor_of
from tilestream.settings import (
    DriveSettings,
    LabelSettings,
    LogOptions,
    LogSettings,
    MapSettings,
    PlaceSettings,
    ReportSettings,
    StartSettings,
    VirtualSettings,
)

Ranges = Annotated[
    list[str],
    typer.Option("--range-max", "--range", help="Usable ranges [m], e.g. 30,60; default: all."),
]
Leaves = Annotated[
    list[str],
    typer.Option(
        "--scan-leaf",
        help="Leaves that scans are thinned by [m], e.g. 0.5,2.0; default: the matcher's.",
    ),
]
BlindRears = Annotated[
    list[str],
    typer.Option(
        "--blind-rear-deg", "--blind-rear", help="Blind sectors at the rear [deg], e.g. 0,120."
    ),
]


OF_CHOICES = ("range_max", "blind_rear_deg", "scan_leaf")
"""Settings of choices that are options of a comparison."""


@on_cluster
@with_settings
def localize(
    store: StoreUrl,
    folder: Annotated[str, typer.Option("--out", help="Folder of the tables.")],
    which_map: Annotated[MapSettings, fields("partial")],
    places: Annotated[PlaceSettings, fields("cell_size", "spacing", "memory")],
    labels: Annotated[
        LabelSettings, fields("matcher", "true_pose", "scans_per_point", "allow_overlap")
    ],
    leaf: Annotated[RegistrationSettings, fields("scan_leaf")],
    starts: Annotated[StartSettings, fields("radius", "step")],
    drive: Annotated[
        DriveSettings,
        fields(
            *("log", "beams", "range_max", "blind_rear_deg", "deskew", "sweep_s"),
            *LogSettings.model_fields,
        ),
    ],
    starts_per_task: Annotated[
        int | None,
        typer.Option(help="Split the starts; default: no.", rich_help_panel=STARTS),
    ] = None,
    dry_run: DryRun = False,
    as_json: AsJson = False,
    cluster: Cluster = HERE,
) -> None:
    """Measure the localization error along a drive: 317 registrations per sample point."""
    given = {name: getattr(leaf, name) for name in leaf.model_fields_set}
    registration = labels.registration.model_copy(update=given)
    how: dict[str, Any] = {
        "cell_size": places.cells_for(registration),
        "spacing": places.spacing,
        "registration": registration,
        "starts": starts,
        "true_pose": labels.true_pose,
        "scans_per_point": labels.scans_per_point,
        "scans": scans_of(drive),
        "starts_per_task": starts_per_task,
        "memory": places.memory,
    }
    opened, reading = map_of(store), reading_of(drive)
    log = opened_log(reading)
    several = labels.scans_per_point
    shared = localize_drive.drive_overlap(
        reading, how["scans"], places.spacing, opened.sources(), several
    )
    of_drive = {drive.log: [*log.notes, *shared.notes], MATCHER: registration.notes}
    notes = noticed(map_notes(opened), of_drive)
    say_notes(notes)
    if not labels.allow_overlap:
        shared.require_none()
    if dry_run:
        out.print(
            plan_table(
                localize_drive.plan_localize(
                    MapPlan.of_store(opened, partial=which_map.partial), reading, folder, **how
                )
            )
        )
        return
    with cluster.client(places.memory) as client, progress() as watch:
        found = localize_drive.localize(
            opened,
            drive.log,
            folder,
            **how,
            reading=reading,
            client=client,
            watch=watch,
            partial=which_map.partial,
            allow_overlap=labels.allow_overlap,
        )
    measured = drive_measured(drive.log, log, how["scans"], places.spacing, found, several)
    off = {drive.log: note_of_log_poses(found)}
    say_notes(off)
    notes = noticed(notes, off)
    if as_json:
        told = {"matcher": registration.told, "drive": measured.plain(), "notes": notes}
        print_json({**told, **error_facts(found)})
    else:
        out.print(error_table(found, registration.told, measured))
        say(f"The tables are in {folder}/errors and {folder}/starts")
    _require_measured(found, measured)


def _require_measured(labels: pd.DataFrame, drive: DriveMeasured) -> None:
    """Fail where a scan of a drive could not be measured, or too little of the drive was.

    Raises:
        PartialError: some scans failed; lists them.
        LimitError: less than `EVALUATED` of what was selected was evaluated, or the drive does not
            fit the map.
    """
    failed = labels[labels["status"] != "done"]
    if len(failed):
        reasons = {f"scan {s}": r for s, r in zip(failed["scan"], failed["reason"], strict=True)}
        told = f"{drive.drive}: {len(failed):,} of {count_of(len(labels), 'scan')} failed:"
        raise PartialError(told, reasons)
    if why := unfit(labels):
        raise LimitError(f"{drive.drive}: {why}")
    if not drive.evaluated:
        raise LimitError(
            f"{drive.drive}: {drive}: less than {EVALUATED:.0%} of what was selected was "
            "evaluated; --from-s and --until-s select a part that has poses"
        )


@on_cluster
@with_settings
def factors(
    store: StoreUrl,
    route: Routes,
    folder: Annotated[str, typer.Option("--out", help="Folder of the tables.")],
    which_map: Annotated[MapSettings, fields("partial")],
    places: Annotated[
        PlaceSettings,
        fields(
            "spacing", "sensor", "sensor_height", "route_z", "cell_size", "project_to", "memory"
        ),
    ],
    log: Annotated[LogOptions, fields(*LogOptions.model_fields)],
    which: Annotated[Which, typer.Option(help="The paper's 20, their robust twins.")] = "all",
    dry_run: DryRun = False,
    as_json: AsJson = False,
    cluster: Cluster = HERE,
) -> None:
    """Compute the factors of the map at every sample point of a route."""
    opened = map_of(store)
    with routes_of(route, places.project_to, places.spacing, opened, log) as (read, notes):
        routes = read.routes
        sensor, height, z = places.looking_sensor, places.sensor_height, places.route_z
        if dry_run:
            looking = Looking(sensor, places.cell_size, which, height, z)
            samples = along_routes.samples_along(opened, routes, places.spacing)
            seen = MapPlan.of_store(opened, partial=which_map.partial)
            plan = along_routes.plan_factors(seen, samples, folder, looking, places.memory)
            out.print(plan_table(plan))
            return
        with cluster.client(places.memory) as client, progress() as watch:
            rows = along_routes.factors_along(
                opened,
                routes,
                folder,
                spacing=places.spacing,
                sensor=sensor,
                sensor_height=height,
                route_z=z,
                cell_size=places.cell_size,
                which=which,
                client=client,
                memory=places.memory,
                watch=watch,
                partial=which_map.partial,
            )
        counts = rows["status"].value_counts()
        notes = noticed(notes, _heights_told(rows, places))
        if as_json:
            found = {str(status): int(count) for status, count in counts.items()}
            print_json({"sample_points": len(rows), **found, "notes": notes})
        else:
            out.print(factor_table(rows))
            say(f"The tables are in {folder}/factors")
        if counts.get("done", 0) < len(rows):
            bad = rows[rows["status"] != "done"]
            names = (
                f"sample point {r} {n}" for r, n in zip(bad.route_id, bad["sample"], strict=True)
            )
            reasons = dict(zip(names, bad["reason"], strict=True))
            raise PartialError(f"{store}: not every sample point has factors:", reasons)


@on_cluster
@with_settings
def compare(
    context: typer.Context,
    store: StoreUrl,
    route: Routes,
    folder: Annotated[str, typer.Option("--out", help="Folder of the page and the tables.")],
    which_map: Annotated[MapSettings, fields("partial")],
    places: Annotated[
        PlaceSettings,
        fields(
            "spacing",
            "sensor_height",
            "route_z",
            "project_to",
            "memory",
            spacing=comparing.SPACING,
        ),
    ],
    labels: Annotated[LabelSettings, fields("matcher")],
    report: Annotated[ReportSettings, fields("threshold")],
    log: Annotated[LogOptions, fields(*LogOptions.model_fields)],
    sensor: Annotated[
        list[str], typer.Option(help=f"{', '.join(SENSORS)}, or a YAML file; several times.")
    ] = ["VLP16"],  # noqa: B006 - as below: typer's way to name a default
    cell_size: Annotated[
        list[str],
        typer.Option(
            help="Edges of the NDT cells [m], e.g. 2.0,1.0; the others are compared with the first."
        ),
    ] = ["2.0"],  # noqa: B006
    ranges: Ranges = [],  # noqa: B006
    blind_rear: BlindRears = ["0"],  # noqa: B006
    leaves: Leaves = [],  # noqa: B006
    cap: Annotated[
        float, typer.Option(help="What 95 % of a tile's estimates must stay within [m].")
    ] = 0.15,
    dry_run: DryRun = False,
    as_json: AsJson = False,
    cluster: Cluster = HERE,
) -> None:
    """Compare lidars, ranges, resolutions of map and scan along routes, from the map alone."""
    check_threshold(cap, "--cap")
    opened = map_of(store)
    with routes_of(route, places.project_to, places.spacing, opened, log) as (read, notes):
        routes = read.routes
        registration = labels.registration
        notes = noticed(notes, {MATCHER: registration.notes})
        say_notes({MATCHER: registration.notes})
        own = None if was_given(context, "cell_size") else registration.resolution
        with options_named({name: flag(name) for name in OF_CHOICES}):
            choices = choices_of(
                [sensor_of(name) for name in sensor],
                numbers(ranges, "--range-max") or (None,),
                numbers(blind_rear, "--blind-rear-deg"),
                numbers(cell_size, "--cell-size") if own is None else [own],
                numbers(leaves, "--scan-leaf") or (None,),
            )
        registration = registration.model_copy(update={"resolution": None})
        height, z = places.sensor_height, places.route_z
        if dry_run:
            plan = comparing.plan_compare(
                opened,
                routes,
                folder,
                choices,
                places.spacing,
                registration,
                height,
                z,
                VirtualSettings(),
                places.memory,
                which_map.partial,
            )
            out.print(plan_table(plan))
            return
        with cluster.client(places.memory) as client, progress() as watch:
            found = comparing.compare(
                opened,
                routes,
                folder,
                choices,
                spacing=places.spacing,
                registration=registration,
                sensor_height=height,
                route_z=z,
                client=client,
                memory=places.memory,
                watch=watch,
                partial=which_map.partial,
            )
        first = found.rows[found.rows["choice"] == found.rows["choice"].iloc[0]]
        found = replace(found, notes=noticed(notes, _heights_told(first, places)))
        content = write_comparison(found, folder, threshold=report.threshold, cap=cap)
        _show_comparison(content, store, folder, as_json)


def _heights_told(rows: pd.DataFrame, places: PlaceSettings) -> dict[str, list[str]]:
    """What the heights of sample points tell, printed."""
    notes = {"routes": notes_of_routes(rows, places.sensor_height, places.route_z)}
    say_notes(notes)
    return notes


def _show_comparison(content: dict[str, Any], store: str, folder: str, as_json: bool) -> None:
    """Print a comparison and where its page is.

    Raises:
        PartialError: no choice has an estimate anywhere.
    """
    if as_json:
        print_json(content)
    else:
        show_worth(content["worth"])
        out.print(comparison_table(content))
        say(f"The page is at {Files.at(folder).under('compare.html').address}")
    if not any(choice["estimated"] for choice in content["choices"]):
        reasons = content["choices"][0]["missing"]
        failures = {
            str(reason): count_of(count, "sample point") for reason, count in reasons.items()
        }
        raise PartialError(f"{store}: no sample point has an estimate:", failures)
