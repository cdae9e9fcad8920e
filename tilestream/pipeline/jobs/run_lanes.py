"""The Lanelet2 maps among the routes of a job, for copies that carry the estimates."""

from collections.abc import Sequence
from pathlib import Path

from tilestream.formats.routes import Lane, read_lanes
from tilestream.pipeline.jobs.run_inputs import Inputs
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.sources import crs_of_map
from tilestream.report.data import LaneletMap


def lanelet_maps_of(settings: RunSettings, inputs: Inputs) -> tuple[LaneletMap, ...]:
    """The Lanelet2 maps that routes of a job are read from, each once."""
    files = [file for file in inputs.route_files if Path(file).suffix.lower() == ".osm"]
    return tuple(
        LaneletMap(file, lambda file=file: _lanes(file, settings, inputs))  # type: ignore[misc]
        for file in dict.fromkeys(files)
    )


def _lanes(file: str, settings: RunSettings, inputs: Inputs) -> Sequence[tuple[str | None, Lane]]:
    """The lanes of a file, each with the name that its route has among those of the job: routes of
    one name have others there, so that a lane is known by where it leads.
    """
    names = {route.positions.tobytes(): route.route_id for route in inputs.routes}
    map_crs = crs_of_map(inputs.sources, settings.store_url, settings.map.crs)
    lanes = read_lanes(file, project_to=settings.project_to, map_crs=map_crs)
    return [(names.get(lane.route.positions.tobytes()), lane) for lane in lanes]
