"""Where a job estimates: its files of routes, else the lanes of its map, else the survey's way."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from tilestream.counts import count_of
from tilestream.errors import UsageError
from tilestream.formats.logs import is_log
from tilestream.formats.routes import RoutesRead, read_all_routes, read_each
from tilestream.notes import some_of
from tilestream.patterns import paths_of
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.sources import crs_of_map
from tilestream.store import open_store

LANES = "lanelet2_map.osm"
"""The lanes that Autoware keeps beside the point clouds of a map."""


def routes_of_map(settings: RunSettings) -> tuple[RoutesRead, list[str], str]:
    """The routes of a job that names none: all lanes of its map, or, where it has none, the way of
    the logs that it is made of; their files, and what is to be told.

    Raises:
        UsageError: the map has neither, or none as long as the spacing.
        StoreError: there are no sources, and no store.
    """
    sources, folders = _sources(settings)
    lanes = [str(folder / LANES) for folder in dict.fromkeys(folders) if (folder / LANES).is_file()]
    if lanes:
        return _lanes(lanes, settings)
    logs = [str(source) for source in dict.fromkeys(sources) if is_log(str(source))]
    if not logs:
        raise UsageError(
            f"{settings.out}: no routes: give files of routes (--route: TUM, KITTI, CSV, GeoJSON, "
            f"Lanelet2 or a log), drives, or a map that has its own: a map directory with {LANES}, "
            "or a log of the survey"
        )
    read = routes_in(logs, settings, settings.map.sources).at_least(settings.spacing)
    told = (
        f"no routes were given, and the map has no lanes: the way of its survey, {some_of(logs, 1)}"
    )
    return read, logs, told


def _sources(settings: RunSettings) -> tuple[list[Path], list[Path]]:
    """What a map is made of, and the folders in which its lanes may be: the map directories among
    its sources; of a store that is there, those of the sources that it knows.
    """
    if not settings.map.sources:
        known = [Path(source["path"]) for source in open_store(settings.store_url).sources()]
        sources = [path for path in known if path.exists()]
        return sources, [folder for path in known for folder in path.parents[:2]]
    sources = [Path(path) for name in settings.map.sources for path in paths_of(name)]
    return sources, sources


def _lanes(files: list[str], settings: RunSettings) -> tuple[RoutesRead, list[str], str]:
    """All lanes of these files that are as long as the spacing."""
    read = routes_in(files, settings, settings.map.sources)
    lanes = read.routes
    long = tuple(lane for lane in lanes if lane.arc_length[-1] >= settings.spacing)
    if not long:
        raise UsageError(
            f"{settings.out}: no routes: all {len(lanes)} lanes of {', '.join(files)} are shorter "
            f"than the spacing, {settings.spacing:g} m"
        )
    many = count_of(len(long), "lane")
    told = f"no routes were given: all streets of the map, {many} of {', '.join(files)}"
    short = len(lanes) - len(long)
    told += f"; {short} shorter than the spacing are left out" if short else ""
    return replace(read, routes=long), files, told


def routes_in(files: Sequence[str], settings: RunSettings, sources: Sequence[str]) -> RoutesRead:
    """The routes of some files, each with a name of its own, in the CRS of the map, which is made
    from these sources. A log that is no drive is read as those of the map.
    """
    map_crs = crs_of_map(sources, settings.store_url, settings.map.crs)
    of_log = {os.path.realpath(drive.log): drive for drive in reversed(settings.drives)}
    wanted = []
    for path in files:  # the way of a drive is that of its own poses
        drive = of_log.get(os.path.realpath(path))
        options = (settings.map if drive is None else drive).log_options
        how = {"project_to": settings.project_to, "map_crs": map_crs, "log_options": options}
        wanted.append((path, how))
    return read_each(wanted, read_all_routes)
