"""Samples: the factors, virtual drives and labels of the same places, joined once."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd

from tilestream.errors import DamagedError, SourceNotFoundError
from tilestream.factors import catalogue, observability
from tilestream.factors.along_route import AVERAGED, averaged_along
from tilestream.factors.own import OWN, columns_in
from tilestream.factors.rows import PLACE_COLUMNS, STATUS_COLUMNS, Samples
from tilestream.factors.virtual_drive import MOMENT_COLUMNS
from tilestream.marks import Mark, hash_of
from tilestream.model.dataset import VIRTUAL_DRIVES, WITHOUT_DRIVES, Dataset
from tilestream.model.features import features_of
from tilestream.model.join import join
from tilestream.pipeline.engine.outputs import Facts, Made, Parquet, Stored
from tilestream.pipeline.engine.stage import Counts, Product, stage
from tilestream.pipeline.stages.factors import factors_drive
from tilestream.pipeline.stages.label import ERROR_COLUMNS, label
from tilestream.pipeline.stages.observe import observe_drive
from tilestream.pipeline.stages.register import register
from tilestream.records import Column
from tilestream.tables import read_mark, read_tables, write_table

FOREST_BYTES = 500_000_000
"""Memory of a task that grows forests on some thousand places, beyond the interpreter."""
BYTES_PER_ROW = 10_000
"""Memory per sample point of a joined table: a thousand numbers in several copies."""

MAY_BE_NAN = ("ob_cov_along", "ob_cov_across", "ob_cov_up", "ob_cov_yaw")
"""Columns of observability that are NaN at some places that have all others; no features, since a
NaN among the features would leave such a place without an estimate."""


def _is_feature(name: str) -> bool:
    """Of the virtual drive what is averaged along the route; of the rest what is a number."""
    return name in AVERAGED if name.startswith("vd_") else name not in MAY_BE_NAN


COLUMNS = (
    *catalogue.COLUMNS,
    *(column for column in observability.COLUMNS if _is_feature(column.name)),
)
"""All factors that a model may learn from."""
DATASET_COLUMNS = (
    Column("group", "place", "", "Which drive, as whose sensor.", "", dtype="str"),
    Column("path", "place", "", "The route that the place lies on, or the drive.", "", dtype="str"),
    Column("block", "place", "", "Piece of the path that is held out as one.", "", dtype="str"),
    Column("distance", "place", "m", "Of the scan from its path, horizontally.", ""),
)
LOST_COLUMNS = (
    *DATASET_COLUMNS,
    Column("sample", "place", "1", "Number of the sample point of the drive.", "", dtype="int64"),
    Column("reason", "place", "", "Why the label is not in the dataset.", "", dtype="str"),
    Column("detail", "place", "", "More of it.", "", dtype="str"),
)


VIRTUAL_COLUMNS = tuple(
    column
    for column in (*DATASET_COLUMNS, *PLACE_COLUMNS, *STATUS_COLUMNS, *COLUMNS, *MOMENT_COLUMNS)
    if column.name in VIRTUAL_DRIVES
)


@dataclass(frozen=True)
class DatasetFile(Parquet):
    """Where the dataset goes; what is lost goes to `lost.parquet` beside it, first, and the virtual
    drives of all places of the drives to `virtual_drives.parquet`.
    """

    def known(self, identity: str) -> Facts | None:
        """As of any table."""
        mark = read_mark(self.path)
        return {"rows": mark.facts["rows"]} if mark.is_of(identity) else None

    def write(self, made: Made, identity: str, columns: Sequence[Column]) -> Facts:  # noqa: ARG002
        """Write the rows, documented, and what was lost."""
        dataset: Dataset = made.value
        frame = dataset.lost.astype({"sample": np.int64})
        frame = frame.assign(detail=frame["detail"].astype(str))
        write_table(self._beside("lost"), frame, LOST_COLUMNS, Mark("done", identity=identity))
        seen = dataset.virtual_drives.astype({"sample": np.int64})
        beside = self._beside("virtual_drives")
        write_table(beside, seen, VIRTUAL_COLUMNS, Mark("done", identity=identity))
        own = [column for column in dataset.columns if column.factor_set == OWN]
        kept = (*DATASET_COLUMNS, *PLACE_COLUMNS, *ERROR_COLUMNS, *features_of(COLUMNS), *own)
        names = {column.name for column in kept}
        rows = dataset.rows[[name for name in dataset.rows if name in names]]
        facts = {
            "rows": len(rows),
            "features": dataset.names,
            "made_with": dict(dataset.made_with),
            "data_sets": {name: dict(facts) for name, facts in dataset.data_sets.items()},
            "stages": dict(dataset.stages),
            **({OWN: [asdict(column) for column in own]} if own else {}),
        }
        write_table(self.path, rows, kept, Mark("done", identity=identity, facts=facts))
        return {"rows": len(rows)}

    def files(self, identity: str) -> dict[str, str]:
        """All three files."""
        names = (self._beside("lost"), self._beside("virtual_drives"), self.path)
        return dict.fromkeys(names, identity)

    def read(self) -> Dataset:
        """The dataset; a process keeps the last one.

        Raises:
            SourceNotFoundError: there is none.
            DamagedError: it is not what was written.
        """
        mark = read_mark(self.path)
        if mark.status == "damaged":
            raise DamagedError(mark.reason)
        if mark.status != "done":
            raise SourceNotFoundError(
                f"{self.path}: no dataset: a job with drives makes one (`tilestream run`), as far "
                f"as it has run; {WITHOUT_DRIVES}"
            )
        return _dataset(self, mark.identity)

    def _beside(self, name: str) -> str:
        return f"{self.path.rsplit('/', 1)[0]}/{name}.parquet"


@lru_cache(maxsize=1)
def _dataset(file: DatasetFile, identity: str) -> Dataset:  # noqa: ARG001 - another is read again
    facts = read_mark(file.path).facts
    known = {column.name: column for column in (*features_of(COLUMNS), *columns_in(facts))}
    columns = tuple(known[name] for name in facts["features"])
    lost, seen = (read_tables([file._beside(name)]) for name in ("lost", "virtual_drives"))
    rows = read_tables([file.path])
    stages = facts.get("stages", {})  # those of older versions do not say it
    return Dataset(rows, columns, lost, facts["made_with"], facts["data_sets"], seen, stages)


@dataclass(frozen=True)
class PlacesOf:
    """The sample points that a table is about: other than its factors, they are the same whatever
    the map, so that a map that changes far from every drive changes no dataset, and no model.
    """

    table: Product
    samples: Samples

    @property
    def identity(self) -> str:
        """Hash of the sample points."""
        return hash_of(self.samples)

    @property
    def makers(self) -> tuple[str, ...]:
        """As of the table."""
        return self.table.makers

    def read(self) -> Stored:
        """The places along their routes; heights are those of the map, and not known here."""
        stored: Stored = self.table.read()
        names = [column.name for column in PLACE_COLUMNS]
        return Stored(stored.rows[names].assign(z=np.nan), {})

    def counts(self) -> Counts:
        """Nothing that memory depends on."""
        return {}


@dataclass(frozen=True)
class DrivesOf:
    """Some drives of a dataset."""

    dataset: Product
    groups: tuple[str, ...]
    """Their names."""

    @property
    def identity(self) -> str:
        """Hash of the dataset and the names."""
        return hash_of((self.dataset.identity, self.groups))

    @property
    def makers(self) -> tuple[str, ...]:
        """As of the dataset."""
        return self.dataset.makers

    def read(self) -> Dataset:
        """Their rows only; drives without a label are not there."""
        dataset: Dataset = self.dataset.read()
        there = set(dataset.rows["group"])
        return dataset.groups([name for name in self.groups if name in there])

    def counts(self) -> Counts:
        """As of the dataset."""
        return self.dataset.counts()


MAKERS = (factors_drive, observe_drive, register, label)
"""The stages that make what is joined."""


@stage(
    "samples",
    version=8,
    memory=lambda counts: FOREST_BYTES + BYTES_PER_ROW * counts["places"],
    seconds=0.001,
)
def samples(
    routes: Sequence[Stored],
    factors: Sequence[Stored],
    observed: Sequence[Stored],
    labels: Sequence[Stored],
    groups: Mapping[str, Sequence[str]],
    making: dict[str, Any],
) -> Dataset:
    """The labels with the factors and virtual drives of their own places alone, as one dataset.

    Args:
        routes: tables of factors along the routes: what the paths are.
        factors: tables of factors at the places of scans.
        observed: tables of observability there; none: the job has no virtual drive.
        labels: tables of errors.
        groups: of each of these tables, which drive it is of, as whose sensor.
        making: what the factors were computed with.
    """
    of_group = {
        name: _by_group(tables, groups[name])
        for name, tables in (("factors", factors), ("observed", observed), ("labels", labels))
    }
    places = {
        name: places_with_factors(tables, of_group["observed"].get(name, ()))
        for name, tables in of_group["factors"].items()
        if name in of_group["observed"] or not observed
    }
    measured = of_group["labels"]
    joined = join(
        _rows(routes),
        places,
        {name: _rows(tables) for name, tables in measured.items()},
        (*COLUMNS, *columns_in(factors[0].facts if factors else {})),
        made_with=making,
        data_sets={name: tables[0].facts["data_set"] for name, tables in measured.items()},
    )
    joined = replace(joined, stages={one.name: one.version for one in MAKERS})
    seen = [_rows(tables).assign(group=name) for name, tables in of_group["observed"].items()]
    names = list(VIRTUAL_DRIVES)
    return replace(joined, virtual_drives=pd.concat(seen)[names]) if seen else joined


def _by_group(tables: Sequence[Stored], groups: Sequence[str]) -> dict[str, list[Stored]]:
    """Tables by the name that each has."""
    found: dict[str, list[Stored]] = {}
    for name, table in zip(groups, tables, strict=True):
        found.setdefault(name, []).append(table)
    return found


def places_with_factors(
    factors: Sequence[Stored], observed: Sequence[Stored], width: float = 0.0
) -> pd.DataFrame:
    """Every sample point of the factor tables with all its factors.

    A place that has the factors and could not be observed has NaN there, and says why. The moments
    of the virtual drive stay in the tables of observability.

    Args:
        factors: tables of factors.
        observed: tables of observability, of the places that may be neighbours too.
        width: over what virtual drives are averaged along the route (`averaged_along`) [m].
    """
    places = _rows(factors)
    if not observed:
        return places
    seen = averaged_along(_rows(observed), width)
    keys = ["route_id", "sample"]
    kept = (column.name for column in observability.COLUMNS if column not in MOMENT_COLUMNS)
    names = [name for name in kept if name in seen]
    seen = seen[[*keys, *names, "status", "reason"]]
    seen = seen.rename(columns={"status": "seen", "reason": "why"})
    joined = places.merge(seen, on=keys, how="left", validate="one_to_one")
    blind = (joined["status"] == "done") & (joined["seen"] != "done")
    joined.loc[blind, "status"] = joined.loc[blind, "seen"].fillna("failed")
    joined.loc[blind, "reason"] = joined.loc[blind, "why"].fillna("its task failed")
    return joined.drop(columns=["seen", "why"])


def _rows(tables: Sequence[Stored]) -> pd.DataFrame:
    return pd.concat([table.rows for table in tables], ignore_index=True)
