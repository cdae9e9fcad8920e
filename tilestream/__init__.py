"""tilestream: the localization error of a LiDAR vehicle at every metre, from the map alone.

```
files -> points -> tile store -> cells -> factors per sample point --+
scans -> 317 registrations each -------> error per sample point -----+-> model -> error everywhere
```

The same bits for any split: on one machine and installation every table up to the report's,
estimates included, has the same bits for any split into tasks, any tiling, any order of files,
places and starts, and any number of workers. So nothing rounds by what else is in its batch: sums
over tiles are of whole numbers, products and sums of rows are in a fixed order
(`kernels/fixed_order.py`), and a product of matrices stays only where no split shows
(`tests/test_bits.py` says where).

Another processor rounds otherwise in compiled kernels: there points and cells are equal, factors
agree to 1e-5 and Hessians to 1e-4 of a column's largest value, and 98 of 100 starts end within 1 mm
of each other (registration is chaotic); what is averaged over starts, or learnt from them, moves
with them.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tilestream.factors.observability import observability as observability
from tilestream.factors.sample_points import sample_points as sample_points
from tilestream.factors.table import factors as factors
from tilestream.formats.logs import ScanSelection as ScanSelection
from tilestream.formats.routes import read_all_routes as read_all_routes
from tilestream.formats.routes import read_route as read_route
from tilestream.formats.routes import read_routes as read_routes
from tilestream.grid import TileKey as TileKey
from tilestream.label import disc_starts as disc_starts
from tilestream.label import localization_error as localization_error
from tilestream.label import refined_pose as refined_pose
from tilestream.label import start_poses as start_poses
from tilestream.matcher import RegistrationSettings as RegistrationSettings
from tilestream.ndt import cells_of as cells_of
from tilestream.pipeline.jobs.along_routes import factors_along as factors_along
from tilestream.pipeline.jobs.along_routes import observe_along as observe_along
from tilestream.pipeline.jobs.ingest import ingest as ingest
from tilestream.pipeline.jobs.localize import localize as localize
from tilestream.pipeline.jobs.starts_of import starts_of as starts_of
from tilestream.records import Cells as Cells
from tilestream.records import LocalizationError as LocalizationError
from tilestream.records import Registrations as Registrations
from tilestream.records import Route as Route
from tilestream.registration import register as register
from tilestream.sensor import HDL64 as HDL64
from tilestream.sensor import OS1_128 as OS1_128
from tilestream.sensor import VLP16 as VLP16
from tilestream.sensor import Sensor as Sensor
from tilestream.settings import LogOptions as LogOptions
from tilestream.settings import StartSettings as StartSettings
from tilestream.settings import VirtualSettings as VirtualSettings
from tilestream.store import Tile as Tile
from tilestream.store import TileStore as TileStore
from tilestream.store import open_store as open_store
from tilestream.version import VERSION

if TYPE_CHECKING:
    from tilestream.apps.view import view as view
    from tilestream.definitions import explain as explain
    from tilestream.pipeline.jobs.estimate import estimate as estimate
    from tilestream.pipeline.jobs.run import dataset as dataset
    from tilestream.pipeline.jobs.run import run as run
    from tilestream.pipeline.jobs.run_settings import RunSettings as RunSettings
    from tilestream.pipeline.jobs.train_over import train_over as train_over


def __getattr__(name: str) -> Any:
    """The main job and the view, when they are asked for: what they need (scikit-learn, Bokeh,
    matplotlib) would cost every worker process 100 MB that its tiles have a use for.
    """
    if name in ("run", "dataset"):
        return getattr(import_module("tilestream.pipeline.jobs.run"), name)
    if name == "estimate":
        return import_module("tilestream.pipeline.jobs.estimate").estimate
    if name == "train_over":
        return import_module("tilestream.pipeline.jobs.train_over").train_over
    if name == "view":
        return import_module("tilestream.apps.view").view
    if name == "explain":
        return import_module("tilestream.definitions").explain
    if name == "RunSettings":
        return import_module("tilestream.pipeline.jobs.run_settings").RunSettings
    raise AttributeError(f"module 'tilestream' has no attribute {name!r}")


__version__ = VERSION
