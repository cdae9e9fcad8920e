"""The map of the dashboard: tiles on the ground by state, relief below, estimates on top."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from bokeh.models import (
    CDSView,
    ColumnDataSource,
    CustomJSTickFormatter,
    DataRange1d,
    GroupFilter,
    HoverTool,
    LinearColorMapper,
)
from bokeh.models.annotations.labels import Label
from bokeh.models.annotations.legends import ScaleBar
from bokeh.plotting import figure

from tilestream.grid import MM_PER_M
from tilestream.pipeline.engine.map_view import MapView, Patch
from tilestream.pipeline.engine.progress import (
    DONE,
    FAILED,
    REFUSED,
    RUNNING,
    STATUSES,
    WAITING,
    Progress,
)
from tilestream.records import Float64
from tilestream.report.city_map import MAP_TOOLS, NORTH, SCALE_BAR, round_corner
from tilestream.report.colours import FIXED, MISSING
from tilestream.report.formatting import CM_PER_M, NONE
from tilestream.report.relief import GREY

EVERY_STAGE = "every stage"
SOFT = "#828a94"
"""Of words and lines that are to be read on a light page and on a dark one."""
COLOURS = dict(zip(STATUSES, (SOFT, "#0072b2", "#009e73", "#d55e00", "#cc79a7"), strict=True))
"""Of the states of tiles (Okabe and Ito's palette)."""
HATCHES = {"failed": "x", "refused": "/"}
"""What tells a state besides its colour; one that runs has a thick outline."""
FILLS = {"waiting": 0.0, "running": 0.22, "done": 0.12, "failed": 0.35, "refused": 0.2}
"""How opaque tiles are: what lies below must be seen."""
MANY = 500
"""Tiles or places above which each of them is drawn smaller."""
TILE_TIP = (
    "<div style='max-width:280px;white-space:normal'><b>tile @tile</b><br>@state<br>@what</div>"
)
PLACE_TIP = [("estimate", "@shown"), ("x, y", "@px{0.0}, @py{0.0}")]
LOOK = ("colour", "alpha", "width", "hatch", "state", "what")
"""Columns of the tiles that change."""


class TileMap:
    """A figure of the tiles of a run, and what is drawn on them; kept up to date piece by piece.

    The data sources are named `relief`, `tiles` and `places`; lengths in metres from `origin` on.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._stage = EVERY_STAGE
        self._read = self._relief_read = 0
        self._places: int | None = None
        self._tile_mm: int | None = None
        self._origin = np.zeros(2)
        self._relief = ColumnDataSource(name="relief", data=self._images([]))
        self._tiles = ColumnDataSource(name="tiles", data=self._columns([]))
        self._marks = ColumnDataSource(name="places", data=self._dots(np.empty((0, 3))))
        self.plot = self._figure()
        self._redraw()

    def choose(self, stage: str) -> None:
        """Colour the tiles by one stage, or by `EVERY_STAGE`."""
        self._stage = stage
        self._redraw()

    def update(self, progress: Progress) -> None:
        """Show what has changed; of another run everything."""
        known = len(self._tiles.data["x"])
        anew = progress is not self._progress or progress.map.tile_mm != self._tile_mm
        self._progress = progress
        if anew or known != len(progress.tiles):
            self._redraw()
            return
        changed = sorted(set(progress.changes[self._read :]))
        self._read = len(progress.changes)
        if changed:
            fresh = self._columns(changed)
            self._tiles.patch({name: list(zip(changed, fresh[name], strict=True)) for name in LOOK})
        self._draw()

    def _redraw(self) -> None:
        """Show all anew."""
        self._read, self._relief_read, self._places = len(self._progress.changes), 0, None
        self._tile_mm = self._progress.map.tile_mm
        self._scale.visible = self._tile_mm is not None
        self._origin = self._corner()
        for axis, name, start in zip(self.plot.axis, "xy", self._origin.tolist(), strict=True):
            unit = f"{name} [m]" if self._tile_mm else f"{name} [tiles]"
            axis.axis_label = f"{unit} from {start:.0f} on" if start else unit
        self._tiles.data = self._columns(range(len(self._progress.tiles)))
        self._relief.data = self._images([])
        self._draw()

    def _draw(self) -> None:
        """What has come on the map since it was drawn last."""
        seen: MapView = self._progress.map
        there, changed = len(self._relief.data["x"]), set(seen.changes[self._relief_read :])
        self._relief_read = len(seen.changes)
        old = sorted(number for number in changed if number < there)
        if old:
            shades = self._images(seen.blocks[number] for number in old)["image"]
            self._relief.patch({"image": list(zip(old, shades, strict=True))})
        if there < len(seen.blocks):
            fresh: Any = self._images(seen.blocks[there:])
            self._relief.stream(fresh)
        if self._places != seen.places:
            self._places = seen.places
            self._marks.data = self._dots(seen.marks)

    def _figure(self) -> figure:
        """An empty map with all that is to be drawn on it."""
        spans = DataRange1d(), DataRange1d(range_padding=0.3)  # there are scale bar and north
        plot = _empty(spans)
        greys = [f"#{GREY:02x}{GREY:02x}{GREY:02x}{alpha:02x}" for alpha in range(256)]
        of_relief: dict[str, Any] = {
            "color_mapper": LinearColorMapper(palette=greys, low=0, high=255),
            "level": "underlay",
        }
        plot.image("image", "x", "y", "dw", "dh", source=self._relief, **of_relief)
        tiles = plot.rect(
            "x",
            "y",
            "edge",
            "edge",
            source=self._tiles,
            fill_color="colour",
            fill_alpha="alpha",
            line_color="colour",
            line_width="width",
            line_alpha=0.8,
        )
        for status, pattern in HATCHES.items():  # a pattern for each tile takes a browser a minute
            of_hatch: dict[str, Any] = {"hatch_pattern": pattern, "hatch_color": COLOURS[status]}
            plot.rect(
                "x",
                "y",
                "edge",
                "edge",
                source=self._tiles,
                view=CDSView(filter=GroupFilter(column_name="hatch", group=pattern)),
                fill_alpha=0.0,
                line_alpha=0.0,
                hatch_alpha=0.7,
                hatch_scale=9.0,
                **of_hatch,
            )
        known = len(FIXED.colours)
        mapper = LinearColorMapper(palette=[MISSING, *FIXED.colours], low=-1, high=known)
        dots = plot.scatter(
            "x",
            "y",
            size="size",
            marker="marker",
            color={"field": "step", "transform": mapper},
            source=self._marks,
        )
        for glyphs, tip, side in ((tiles, TILE_TIP, "below"), (dots, PLACE_TIP, "above")):
            how: dict[str, Any] = {"tooltips": tip, "attachment": side, "visible": False}
            plot.add_tools(HoverTool(renderers=[glyphs], limit=1, **how))
        for span in spans:
            span.renderers = [tiles]
        self._scale = ScaleBar(**SCALE_BAR, bar_length=0.2, label_text_color=SOFT)
        plot.add_layout(self._scale)
        plot.add_layout(Label(**NORTH, text_color=SOFT))
        return plot

    def _corner(self) -> Float64:
        """A round corner near the tiles, so that axes need not show seven digits [m]."""
        if self._tile_mm is None or not self._progress.tiles:
            return np.zeros(2)
        return round_corner(np.min(self._progress.tiles, axis=0) * (self._tile_mm / MM_PER_M))

    def _images(self, patches: Iterable[Patch]) -> dict[str, Any]:
        left, low = self._origin
        found: dict[str, list[Any]] = {name: [] for name in ("image", "x", "y", "dw", "dh")}
        for patch in patches:
            rows, columns = patch.shades.shape
            size = columns * patch.pixel, rows * patch.pixel
            values = (patch.shades.copy(), patch.x - left, patch.y - low, *size)
            for name, value in zip(found, values, strict=True):
                found[name].append(value)
        return found

    def _dots(self, marks: Float64) -> dict[str, Any]:
        """The places, the worst last, which is on top."""
        marks = marks[np.argsort(np.nan_to_num(marks[:, 2], nan=-1.0), kind="stable")]
        step = FIXED.step(marks[:, 2])
        share = np.clip(step, 0, None) / (len(FIXED.colours) - 1)
        size = np.where(step < 0, 7.0, 4.0 + 6.0 * share) * _smaller(len(marks))
        return {
            "x": (marks[:, 0] - self._origin[0]).astype(np.float32),
            "y": (marks[:, 1] - self._origin[1]).astype(np.float32),
            "px": marks[:, 0],
            "py": marks[:, 1],
            "step": (step + 0.5).astype(np.float32),
            "size": size.astype(np.float32),
            "marker": ["circle" if known else "x" for known in (step >= 0).tolist()],
            "shown": [
                f"{e * CM_PER_M:.0f} cm" if known else NONE
                for e, known in zip(marks[:, 2].tolist(), (step >= 0).tolist(), strict=True)
            ],
        }

    def _columns(self, places: Iterable[int]) -> dict[str, Any]:
        """How the tiles at these places of the list of tiles look."""
        found: dict[str, list[Any]] = {name: [] for name in ("x", "y", "edge", "tile", *LOOK)}
        names = [stage.name for stage in self._progress.stages]
        thin = _smaller(len(self._progress.tiles))
        for place in places:
            tile = self._progress.tiles[place]
            x, y, edge = self._progress.map.box(tile)
            statuses = self._progress.statuses(place)
            what = ", ".join(f"{names[stage]}: {STATUSES[status]}" for stage, status in statuses)
            shown = [s for n, s in statuses if self._stage in (EVERY_STAGE, names[n])]
            where = (x - self._origin[0], y - self._origin[1], edge, f"{tile[0]}_{tile[1]}")
            for name, value in zip(found, (*where, *look(shown, thin), what), strict=True):
                found[name].append(value)
        return found


def _empty(spans: tuple[DataRange1d, DataRange1d]) -> figure:
    """A figure of equal scale that is calm, and see-through."""
    plot = figure(
        x_range=spans[0],
        y_range=spans[1],
        sizing_mode="stretch_both",
        min_height=240,
        match_aspect=True,
        tools=MAP_TOOLS,
        active_scroll="wheel_zoom",
        output_backend="canvas",
        name="map",
    )
    plot.toolbar.logo = None
    plot.toolbar_location = "above"
    plot.background_fill_alpha = plot.border_fill_alpha = 0.0
    plot.outline_line_color = None
    plot.grid.visible = False
    plot.axis.axis_line_alpha = 0.4
    plot.axis.minor_tick_line_color = None
    plot.axis.major_label_text_color = plot.axis.axis_label_text_color = SOFT
    plot.axis.axis_label_text_font_size = "12px"
    plot.axis.formatter = CustomJSTickFormatter(code="return String(+tick.toFixed(2))")
    return plot


def _smaller(count: int) -> float:
    """By how much marks shrink where there are many of them, at most to 40 %."""
    return float(np.clip(np.sqrt(MANY / max(1, count)), 0.4, 1.0))


def look(statuses: Sequence[int], thin: float = 1.0) -> tuple[str, float, float, str, str]:
    """Colour, opacity, width of the outline, hatch and state in words of a tile.

    What has failed comes first, then what was refused because of it, what runs, and what is done:
    the more of the tile's tasks, the fuller. No task of the chosen stage: an outline.

    Args:
        statuses: of its tasks that are looked at.
        thin: what the width of the outline is multiplied by.
    """
    if not statuses:
        return COLOURS["waiting"], 0.0, 0.3 * thin, "", "no task"
    done = statuses.count(DONE)
    told = f"{done} of {len(statuses)} tasks done"
    first = next(
        (s for s in (FAILED, REFUSED, RUNNING) if s in statuses), DONE if done else WAITING
    )
    name = STATUSES[first]
    alpha = FILLS[name] * (done / len(statuses) if first == DONE else 1.0)
    words = f"waiting, {told}" if first == DONE and done < len(statuses) else f"{name}, {told}"
    width = thin * (2.5 if first == RUNNING else 1.0)
    return COLOURS[name], alpha, width, HATCHES.get(name, ""), words
