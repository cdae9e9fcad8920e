"""The command that shows the tiles of a store, and what it shows of them."""

from dataclasses import asdict
from typing import Any

from rich.box import SIMPLE
from rich.table import Table

from tilestream.cli.options import AsJson, StoreUrl
from tilestream.cli.printing import out, print_json, say, say_notes
from tilestream.errors import PartialError
from tilestream.files import Files
from tilestream.pipeline.jobs.run_folder import map_of
from tilestream.pipeline.jobs.run_state import record_of, state_told
from tilestream.pipeline.jobs.sources import map_notes
from tilestream.store import POINTS, TileStore


def status(
    store: StoreUrl,
    as_json: AsJson = False,
) -> None:
    """Show the tiles of a store: counts, extents, status and reasons."""
    opened, run = map_of(store), record_of(Files.at(store))
    marks = opened.marks(POINTS)
    failures = {f"tile {k}": m.reason for k, m in marks.items() if m.status == "failed"}
    failures |= {s["path"]: s["reason"] for s in opened.sources() if s["reason"]}
    condition = opened.condition()
    failures |= {} if condition.whole else {opened.url: str(condition)}
    state = state_told(Files.at(store), run) if run else "whole"
    failures |= {} if state == "whole" else {"the run": state}
    if as_json:
        print_json(store_facts(opened) | ({"run": state} if run else {}))
    else:
        out.print(tile_table(opened))
        if run:
            say(f"The run is {state}")
        more = ", by its marks: `tilestream verify` reads all of it" if condition.whole else ""
        say(f"The map is {condition}{more}")
        say_notes(map_notes(opened))
    if failures:
        raise PartialError(f"{store} is not whole, or parts of it failed:", failures)


def store_facts(store: TileStore) -> dict[str, Any]:
    """A tile store for machines: its state, its tiles, and what was noticed of its sources."""
    condition = store.condition()
    ours = ("scans", "told")  # of each scan of a log, for nobody to read; what notes have too
    sources = [{k: v for k, v in one.items() if k not in ours} for one in store.sources()]
    return {
        "url": store.url,
        "whole": condition.whole,
        "condition": str(condition),
        "settings": asdict(store.settings),
        "sources": sources,
        "notes": map_notes(store),
        "tiles": {str(key): asdict(mark) for key, mark in store.marks(POINTS).items()},
    }


def tile_table(store: TileStore) -> Table:
    """The tiles of a store with status, counts and extents."""
    table = Table(title=str(store), title_justify="left", box=SIMPLE)
    for column in ("tile", "status", "points", "read", "lowest [m]", "highest [m]", "reason"):
        right = column in ("points", "read")
        table.add_column(column, justify="right" if right else "left", no_wrap=column != "reason")
    for key, mark in store.marks(POINTS).items():
        facts = mark.facts
        lowest, highest = (
            " ".join(f"{value:z.1f}" for value in facts.get(end, ()))
            for end in ("lowest", "highest")
        )
        points, read = (f"{facts[name]:,}" if name in facts else "" for name in ("points", "read"))
        table.add_row(str(key), mark.status, points, read, lowest, highest, mark.reason)
    return table
