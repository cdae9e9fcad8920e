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

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

from tilestream.version import VERSION

if TYPE_CHECKING:
    from tilestream.apps.advise import Advice, advise
    from tilestream.apps.choices import Choice, choices_of
    from tilestream.apps.compare import compare
    from tilestream.apps.covariances import Covariances, covariances
    from tilestream.apps.diff import diff
    from tilestream.apps.export.covariance import export
    from tilestream.apps.info import info
    from tilestream.apps.runs import Run, open_run, read_run
    from tilestream.apps.verbs import demo, plan, simulate, status, template
    from tilestream.apps.verify import repair, verify
    from tilestream.apps.view import view
    from tilestream.apps.warm import warm
    from tilestream.cli.progress import progress
    from tilestream.definitions import explain
    from tilestream.factors.observability import observability
    from tilestream.factors.sample_points import sample_points
    from tilestream.factors.table import factors
    from tilestream.formats.logs import ScanSelection
    from tilestream.formats.routes import read_all_routes, read_route, read_routes
    from tilestream.grid import TileKey
    from tilestream.label import (
        disc_starts,
        localization_error,
        refined_pose,
        start_poses,
    )
    from tilestream.matcher import RegistrationSettings
    from tilestream.ndt import cells_of
    from tilestream.pipeline.jobs.along_routes import factors_along, observe_along
    from tilestream.pipeline.jobs.estimate import estimate
    from tilestream.pipeline.jobs.ingest import ingest
    from tilestream.pipeline.jobs.localize import localize
    from tilestream.pipeline.jobs.run import dataset, run
    from tilestream.pipeline.jobs.run_settings import RunSettings
    from tilestream.pipeline.jobs.starts_of import starts_of
    from tilestream.pipeline.jobs.train_over import train_over
    from tilestream.pipeline.jobs.unfit import unfit
    from tilestream.pipeline.stages.drive_scans import Reading
    from tilestream.records import Cells, Column, LocalizationError, Registrations, Route
    from tilestream.registration import register
    from tilestream.sensor import HDL64, OS1_128, VLP16, Sensor
    from tilestream.settings import LogOptions, StartSettings, VirtualSettings
    from tilestream.store import Tile, TileStore, open_store

__all__ = [
    "HDL64",
    "OS1_128",
    "VLP16",
    "Advice",
    "Cells",
    "Choice",
    "Column",
    "Covariances",
    "LocalizationError",
    "LogOptions",
    "Reading",
    "RegistrationSettings",
    "Registrations",
    "Route",
    "Run",
    "RunSettings",
    "ScanSelection",
    "Sensor",
    "StartSettings",
    "Tile",
    "TileKey",
    "TileStore",
    "VirtualSettings",
    "advise",
    "cells_of",
    "choices_of",
    "compare",
    "covariances",
    "dataset",
    "demo",
    "diff",
    "disc_starts",
    "estimate",
    "explain",
    "export",
    "factors",
    "factors_along",
    "info",
    "ingest",
    "localization_error",
    "localize",
    "observability",
    "observe_along",
    "open_run",
    "open_store",
    "plan",
    "progress",
    "read_all_routes",
    "read_route",
    "read_routes",
    "read_run",
    "refined_pose",
    "register",
    "repair",
    "run",
    "sample_points",
    "simulate",
    "start_poses",
    "starts_of",
    "status",
    "template",
    "train_over",
    "unfit",
    "verify",
    "view",
    "warm",
]

_LATE = {
    "apps.advise": ("Advice", "advise"),
    "apps.choices": ("Choice", "choices_of"),
    "apps.compare": ("compare",),
    "apps.covariances": ("Covariances", "covariances"),
    "apps.diff": ("diff",),
    "apps.export.covariance": ("export",),
    "apps.info": ("info",),
    "apps.runs": ("Run", "open_run", "read_run"),
    "apps.verbs": ("demo", "plan", "simulate", "status", "template"),
    "apps.verify": ("repair", "verify"),
    "apps.view": ("view",),
    "apps.warm": ("warm",),
    "cli.progress": ("progress",),
    "definitions": ("explain",),
    "factors.observability": ("observability",),
    "factors.sample_points": ("sample_points",),
    "formats.logs": ("ScanSelection",),
    "formats.routes": ("read_all_routes", "read_route", "read_routes"),
    "grid": ("TileKey",),
    "label": ("disc_starts", "localization_error", "refined_pose", "start_poses"),
    "matcher": ("RegistrationSettings",),
    "ndt": ("cells_of",),
    "pipeline.jobs.along_routes": ("factors_along", "observe_along"),
    "pipeline.jobs.estimate": ("estimate",),
    "pipeline.jobs.ingest": ("ingest",),
    "pipeline.jobs.localize": ("localize",),
    "pipeline.jobs.run": ("dataset", "run"),
    "pipeline.jobs.run_settings": ("RunSettings",),
    "pipeline.jobs.starts_of": ("starts_of",),
    "pipeline.jobs.train_over": ("train_over",),
    "pipeline.jobs.unfit": ("unfit",),
    "pipeline.stages.drive_scans": ("Reading",),
    "records": ("Cells", "Column", "LocalizationError", "Registrations", "Route"),
    "registration": ("register",),
    "sensor": ("HDL64", "OS1_128", "Sensor", "VLP16"),
    "settings": ("LogOptions", "StartSettings", "VirtualSettings"),
    "store": ("Tile", "TileStore", "open_store"),
}
"""What is imported when it is asked for: the list of commands needs none of it, and what some of it
needs (scikit-learn, Bokeh, matplotlib) would cost every worker process 100 MB that its tiles have a
use for."""


def __getattr__(name: str) -> Any:
    for module, names in _LATE.items():
        if name in names:
            return getattr(import_module(f"tilestream.{module}"), name)
    raise AttributeError(f"module 'tilestream' has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__all__)


class _Api(ModuleType):
    """The one function of the API that has the name of a folder, which Python sets here."""

    @property
    def factors(self) -> Any:
        """As the others, imported when it is asked for."""
        return import_module("tilestream.factors.table").factors

    @factors.setter
    def factors(self, folder: ModuleType) -> None:
        """The folder is found by its imports without."""


sys.modules[__name__].__class__ = _Api


__version__ = VERSION
