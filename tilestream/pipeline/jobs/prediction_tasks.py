"""The tasks that estimate the sample points of a run, tile by tile."""

from collections.abc import Iterable, Mapping
from typing import Any

from tilestream.factors.along_route import REACH
from tilestream.grid import MM_PER_M, TileGrid, TileKey
from tilestream.pipeline.engine.outputs import Parquet
from tilestream.pipeline.engine.stage import Readable, Stage, Task
from tilestream.pipeline.jobs.estimator import Estimator
from tilestream.pipeline.jobs.run_making import making_of
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.stages.between import Between
from tilestream.pipeline.stages.predict import predict
from tilestream.pipeline.stages.train import ModelInUse

NEIGHBOURS_MM = round(REACH * MM_PER_M) + 1
"""How far from a tile a sample point of it may have neighbours, rounding included [mm]."""


def model_there(estimator: Estimator) -> ModelInUse | None:
    """The model in use; None: none is there."""
    return None if estimator.use is None else ModelInUse.of(estimator.use)


def prediction_tasks(
    settings: RunSettings,
    grid: TileGrid,
    factors: Iterable[Task],
    observed: Iterable[Task],
    model: Readable | None,
    between: Mapping[TileKey, Between] | None = None,
    applies: Stage = predict,
    table: str = "predictions",
) -> list[Task]:
    """A task per tile, which reads the observability of the neighbours of its sample points too.

    Args:
        settings: the job.
        grid: of the map.
        factors: those of the tiles.
        observed: the observability there and around, of a tile maybe in several tables.
        model: None: the virtual drive as it is.
        between: by tile, where a coarse run interpolates.
        applies: `predict`, or `stations`.
        table: folder of the tables, below that of all; the tasks of another one are named by it.
    """
    of_tile: dict[TileKey | None, list[Task]] = {}
    for task in observed:
        of_tile.setdefault(task.tile, []).append(task)
    making = making_of(settings)
    reads: dict[str, Any] = {} if model is None else {"model": model}
    tasks = []
    for task in factors:
        assert task.tile is not None
        near = [one for key in neighbours(grid, task.tile) for one in of_tile.get(key, ())]
        takes = {
            "making": making,
            "offset": settings.model.offset or 0.0,
            "prediction_error": settings.prediction_error,
        }
        below = table.partition("/")[2]
        tasks.append(
            Task(
                applies,
                f"{below}-{task.tile}" if below else str(task.tile),
                Parquet(f"{settings.out}/tables/{table}/{task.tile}.parquet"),
                takes=takes | ({} if between is None else {"between": between[task.tile]}),
                reads={**reads, "factors": task.product, "observed": products(near)},
                work=task.work,
                counts={"places": sum(one.work for one in (task, *near))},
                tile=task.tile,
            )
        )
    return tasks


def neighbours(grid: TileGrid, tile: TileKey) -> Iterable[TileKey]:
    """The tiles whose sample points may be neighbours of a tile's."""
    return grid.keys_over(grid.core(tile).grown(NEIGHBOURS_MM))


def products(tasks: Iterable[Task]) -> tuple[Readable, ...]:
    """What tasks make, to be read."""
    return tuple(task.product for task in tasks)
