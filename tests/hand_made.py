"""Tables that a test writes by hand, listed as a job would list them."""

from pathlib import Path

from tilestream.files import Files
from tilestream.pipeline.jobs.inventory import Entry, write_inventory
from tilestream.tables import read_mark


def listed(folder: Path) -> None:
    """Write the inventories of all tables below a folder."""
    for place in {path.parent for path in folder.rglob("*.parquet")}:
        entries = {
            path.name: Entry("by hand", read_mark(str(path)).identity)
            for path in place.glob("*.parquet")
        }
        write_inventory(Files.at(place), entries)
