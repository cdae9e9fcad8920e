"""One viewer's page on the dashboard: where the run is, its map, its stages, workers, failures."""

from pathlib import Path
from typing import Any, Protocol

from bokeh.document import Document
from bokeh.models.widgets import Div, Select
from distributed.dashboard.components.scheduler import BOKEH_THEME, env

from tilestream.pipeline.engine.dashboard.map import EVERY_STAGE, TileMap
from tilestream.pipeline.engine.dashboard.words import (
    STYLE,
    failures_html,
    head_html,
    legend_html,
    stages_html,
    workers_html,
)
from tilestream.pipeline.engine.progress import Progress

LOOK_EVERY_MS = 1000
"""How often the memory of the workers is looked at, and the page redrawn [ms]."""
TEMPLATE = Path(__file__).with_name("page.html.j2")


class Source(Protocol):
    """Where a page gets what it shows."""

    @property
    def progress(self) -> Progress:
        """The run that was begun last."""

    def facts(self) -> dict[str, Any]:
        """What machines get of it."""


class Page:
    """One viewer's page."""

    def __init__(self, source: Source, extra: dict[str, Any], doc: Document) -> None:
        self._from = source
        self._map = TileMap(source.progress)
        offered: list[Any] = [EVERY_STAGE]
        self._select = Select(options=offered, value=EVERY_STAGE, name="stage", stylesheets=[STYLE])
        self._select.on_change("value", lambda attr, old, new: self._map.choose(str(new)))  # noqa: ARG005 - Bokeh asks for just these
        self._words = {
            name: Div(name=name, stylesheets=[STYLE], sizing_mode="stretch_width")
            for name in ("head", "legend", "stages", "workers", "failures")
        }
        for root in (*self._words.values(), self._select, self._map.plot):
            doc.add_root(root)
        doc.title = "Tilestream"
        doc.template = env.from_string(TEMPLATE.read_text("utf-8"))
        doc.template_variables.update(extra)
        doc.theme = BOKEH_THEME
        doc.add_periodic_callback(self.update, LOOK_EVERY_MS)
        self._write()

    def update(self) -> None:
        """Show what has changed."""
        self._map.update(self._from.progress)
        self._write()

    def _write(self) -> None:
        """The words beside the map."""
        facts = self._from.facts()
        options: list[Any] = [EVERY_STAGE, *(stage["stage"] for stage in facts["stages"])]
        if self._select.options != options:
            self._select.options = options
            if self._select.value not in options:
                self._select.value = EVERY_STAGE
        for name, text in (
            ("head", head_html(facts)),
            ("legend", legend_html(facts["map"])),
            ("stages", stages_html(facts["stages"])),
            ("workers", workers_html(facts["workers"], facts["promised_bytes"])),
            ("failures", failures_html(facts)),
        ):
            self._words[name].text = text
