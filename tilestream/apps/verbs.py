"""The commands of the command line that are no job of their own, as functions."""

import json
import os
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Any

import pandas as pd

from tilestream.pipeline.engine.costs import core_hours
from tilestream.pipeline.engine.executor import Watch
from tilestream.pipeline.engine.stage import Task
from tilestream.pipeline.jobs import run as main_job
from tilestream.pipeline.jobs import simulate as simulation
from tilestream.pipeline.jobs.forecast import forecast, to_do
from tilestream.pipeline.jobs.run_settings import RunSettings, read_settings
from tilestream.pipeline.jobs.simulation_record import Size
from tilestream.records import District
from tilestream.simulation.settings import settings_in
from tilestream.store import Condition, open_store

SHIPPED = resources.files("tilestream") / "data"


def template() -> str:
    """A job for your city, as the text of a YAML file that explains every setting.

    Examples:
        >>> ts.template().startswith("# A job for your city")
        True
    """
    return (SHIPPED / "city.yaml").read_text()


def plan(config: RunSettings | str | os.PathLike[str]) -> pd.DataFrame:
    """What a job would run; nothing is read beyond headers, nothing is written.

    Args:
        config: the settings, or a YAML file of them, as `ts.run` takes it.

    Returns:
        A row per stage: `stage`, `tasks`, `work` (in what the stage counts), `to_do` (the part of
        the work that is not done), `after` (the stages that it waits for), `promised_bytes` (the
        most that one of its tasks may use), `core_hours` (of what is to do). `attrs["notes"]` has
        what was noticed, by source, `attrs["update"]` what an update of the map reaches at most
        (None: it is none).

    Raises:
        PlanError: a task does not fit `memory`.
        UsageError, SourceError, StoreError, ModelError: as the job itself.

    Examples:
        >>> planned = ts.plan("job.yaml")
        >>> planned.set_index("stage").loc["predict", "work"].item()
        7
    """
    expected = forecast(config if isinstance(config, RunSettings) else read_settings(config))
    table = pd.DataFrame(
        stage_rows(expected.tasks),
        columns=["stage", "tasks", "work", "to_do", "after", "promised_bytes", "core_hours"],
    )
    table.attrs["update"] = expected.update
    table.attrs["notes"] = {source: list(notes) for source, notes in expected.notes.items()}
    return table


def stage_rows(tasks: Sequence[Task]) -> list[dict[str, object]]:
    """The stages of some tasks, in their order; the columns of `plan`."""
    left = to_do(tasks)
    hours = core_hours(left)
    stages = {task.key: task.stage for task in tasks}
    rows: list[dict[str, object]] = []
    for stage in dict.fromkeys(stages.values()):
        own = [task for task in tasks if task.stage == stage]
        after = {stages[need] for task in own for need in task.needs if need in stages}
        rows.append(
            {
                "stage": stage,
                "tasks": len(own),
                "work": sum(task.work for task in own),
                "to_do": sum(task.work for task in left if task.stage == stage),
                "after": sorted(after - {stage}),
                "promised_bytes": max(task.promised_bytes for task in own),
                "core_hours": round(hours.get(stage, 0.0), 4),
            }
        )
    return rows


def simulate(
    out: str | os.PathLike[str],
    *,
    city: District = "shinjuku",
    preset: str = "physical",
    drive: int = 0,
    seed: int = 0,
    paths: Sequence[str] | None = None,
    scans_per_point: int = 1,
    every: int = 1,
    survey_of: str | os.PathLike[str] | None = None,
    size: Size = "full",
    client: Any | None = None,
    watch: Watch | None = None,
) -> Path:
    """Simulate a survey of a district and drives through it; a killed simulation continues.

    Args:
        out: the directory of the map (`survey/`), the logs (`logs/`) and `routes.geojson`.
        city: `shinjuku`, with the paper's five paths, or `sendagaya`, three other streets.
        preset: `physical`, `paper`, or a YAML file of simulation settings.
        drive: its number: another one of the same seed drives the same streets again.
        seed: of everything that is simulated.
        paths: only these streets; None: all.
        scans_per_point: turns of the lidar kept at each sample point.
        every: only each so-many-th sample point is scanned.
        survey_of: the directory of a simulation of the same city whose survey is the map.
        size: `small`: the first 40 m of each path and a thin survey.
        client: a Dask client to run on; None: this process.
        watch: is told of each task that ended.

    Returns:
        The directory.

    Raises:
        SourceNotFoundError: no such preset or file.
        UsageError, PlanError, LockedError, PartialError: as `simulation.simulate`.
    """
    settings = settings_in(city, preset).model_copy(update={"drive": drive, "seed": seed})
    return simulation.simulate(
        settings,
        Path(out),
        paths=paths,
        scans_per_point=scans_per_point,
        every=every,
        survey_of=None if survey_of is None else os.fspath(survey_of),
        size=size,
        client=client,
        watch=watch,
    )


def status(store: str | os.PathLike[str]) -> Condition:
    """Whether a map is whole, being written, half-made or damaged, with the marks of its tiles.

    Args:
        store: a tile store, a path or an fsspec URL.

    Raises:
        StoreError: as `ts.open_store`.

    Examples:
        >>> str(ts.status("map.zarr"))
        'whole'
    """
    return open_store(store).condition()


def demo(
    out: str | os.PathLike[str] = "tilestream-demo",
    client: Any | None = None,
    watch: Watch | None = None,
) -> Path | str:
    """A street of Shinjuku from its map alone, and what a drive measures: minutes, no files.

    Arguments, result and errors as `ts.run`, with a run directory in place of settings.
    """
    return main_job.run(demo_settings(out), client, watch)


def demo_settings(out: str | os.PathLike[str]) -> RunSettings:
    """The settings of the demo, which writes to a run directory."""
    with resources.as_file(SHIPPED / "demo.yaml") as path:
        return read_settings(path, [f"out={json.dumps(os.fspath(out))}"])
