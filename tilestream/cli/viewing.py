"""The command that shows a map in 3D, and the legend of its colours."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.text import Text

from tilestream.apps.scene import MOST_POINTS, Scene, scene_of
from tilestream.apps.view import require_display, show
from tilestream.cli.printing import out, say_notes
from tilestream.counts import count_of
from tilestream.files import Files
from tilestream.grid import TileKey
from tilestream.pipeline.jobs.run_folder import map_of
from tilestream.pipeline.jobs.run_state import record_of
from tilestream.pipeline.jobs.sources import map_notes
from tilestream.report.colours import FIXED
from tilestream.report.formatting import CM_PER_M


def view(
    place: Annotated[
        str, typer.Argument(help="A tile store, or a run directory: `run`, `localize`, `factors`.")
    ],
    tile: Annotated[
        str | None, typer.Option(help="Only this tile, as `status` names it, e.g. 12_-3.")
    ] = None,
    screenshot: Annotated[
        Path | None, typer.Option(help="Write this PNG instead of opening a window.")
    ] = None,
    points: Annotated[
        int, typer.Option(min=1, help="Of a larger map, show a sample of so many points.")
    ] = MOST_POINTS,
) -> None:
    """Show a map in 3D, the route on it coloured by measured or estimated error."""
    key = None if tile is None else TileKey.parse(tile)
    record_of(Files.at(place))  # a damaged one is refused whether a window opens or not
    require_display(screenshot)
    say_notes(map_notes(map_of(place)))
    scene = scene_of(place, tile=key, points=points)
    for line in legend(scene):
        out.print(line, soft_wrap=True, highlight=False)
    if screenshot is None:
        out.print("Drag to turn, wheel to zoom, + and - to size the points, Q to close.")
    show(scene, screenshot)


def legend(scene: Scene) -> list[Text]:
    """What the points are, and what the colours of the places mean."""
    low, high = scene.height_range
    told = f"map: {len(scene.points):,} of {count_of(scene.total, 'point')}, "
    told += f"{count_of(len(scene.tiles), 'tile')}, "
    lines = [Text(told + f"from dark at {low:.1f} m to bright at {high:.1f} m")]
    measured, known = scene.measured.sum(), np.isfinite(scene.error).sum()
    if len(scene.places):
        told = f"route: {count_of(measured, 'place')} measured (large), "
        told += f"{known - measured:,} estimated "
        between = int(scene.interpolated.sum())
        told += f"(small{f', {between:,} of them interpolated' if between else ''}), "
        lines.append(Text(told + f"{len(scene.places) - known:,} neither (grey)"))
    if known:
        edges = [f" {edge * CM_PER_M:g} " for edge in FIXED.edges] + [""]
        line = Text("error [cm]: ")
        for colour, edge in zip(FIXED.colours, edges, strict=True):
            line.append("██", colour).append(edge)
        lines.append(line)
    return lines
