"""One dataset from several runs: other lidars, presets, seeds and matchers, and their districts."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import pandas as pd

from tilestream.errors import ModelError, UsageError
from tilestream.model.dataset import TARGETS, VIRTUAL_DRIVES, Dataset
from tilestream.model.making import MAY_DIFFER, SEEING, judged_of, lidar_of, shared
from tilestream.sensor import AS_RECORDED

PLACES = ("group", "path", "block")
"""What is named `<run>/<name>`."""
DISTRICT = "one district"
"""Of runs whose district nobody has named: together, so that none of their streets can be held out
and train."""


@dataclass(frozen=True, eq=False)
class Run:
    """A run to be trained over."""

    dataset: Dataset
    """What it has measured."""
    district: str = DISTRICT
    """Where: streets of the same name in one district are the same street, in the same frame."""
    makings: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """What the factors of its groups were computed with, where that differs from the dataset's
    `made_with`: drives that are read as a simpler lidar."""
    about: Mapping[str, Any] = field(default_factory=dict)
    """What else is known of it, plain JSON: preset, seed, …"""


def over_runs(runs: Mapping[str, Run]) -> Dataset:
    """One dataset of several runs, whose rows are named `<run>/<group>`, `<run>/<path>` and
    `<run>/<block>`, and have besides `street` and `piece` (path and block by district), `district`
    and `lidar` (in words).

    Args:
        runs: by name.

    Raises:
        UsageError: no run, or a name with a `/`.
        ModelError: the runs differ in what must be equal: cell size, thinning of the map, how the
            virtual drive is drawn, units, factors, targets, versions of stages; or a drive is
            read as another lidar and nobody says which. Names runs and what differs.
    """
    if not runs:
        raise UsageError("no run to train over")
    for name in runs:
        if not name or "/" in name:
            raise UsageError(f"a run is named {name!r}: give a name without /")
    makings = {f"{r}/{g}": making for r in runs for g, making in _makings(r, runs[r]).items()}
    _same(runs, makings)
    first = next(iter(runs.values())).dataset
    return Dataset(
        pd.concat([_rows(name, run, makings) for name, run in runs.items()], ignore_index=True),
        first.columns,
        pd.concat([_named(r, run.dataset.lost) for r, run in runs.items()], ignore_index=True),
        shared(next(iter(makings.values())), judged_of(list(makings.values()))),
        {f"{r}/{g}": ids for r, run in runs.items() for g, ids in run.dataset.data_sets.items()},
        _virtual_drives(runs),
        first.stages,
        makings,
        {name: {"district": run.district, **run.about} for name, run in runs.items()},
    )


def _virtual_drives(runs: Mapping[str, Run]) -> pd.DataFrame:
    seen = [_named(name, run.dataset.virtual_drives) for name, run in runs.items()]
    there = [table for table in seen if not table.empty]
    if not there:
        return pd.DataFrame(columns=list(VIRTUAL_DRIVES))
    return pd.concat(there, ignore_index=True)


def _makings(name: str, run: Run) -> dict[str, Mapping[str, Any]]:
    """What each labelled group of a run was made with."""
    found = {}
    for group in sorted(set(run.dataset.rows["group"])):
        as_sensor = run.dataset.data_sets.get(group, {}).get("as_sensor", AS_RECORDED)
        if as_sensor != AS_RECORDED and group not in run.makings:
            raise ModelError(
                f"run {name!r}: drive {group} is read as {as_sensor}, and the dataset alone does "
                "not say what that sees: give the run directory"
            )
        found[group] = run.makings.get(group, run.dataset.made_with)
    return found


def _rows(name: str, run: Run, makings: Mapping[str, Mapping[str, Any]]) -> pd.DataFrame:
    rows = run.dataset.rows
    lidars = {g: lidar_of(makings[f"{name}/{g}"]) for g in set(rows["group"])}
    return _named(name, rows).assign(
        street=f"{run.district}/" + rows["path"],
        piece=f"{run.district}/" + rows["block"],
        district=run.district,
        lidar=rows["group"].map(lidars),
    )


def _named(name: str, table: pd.DataFrame) -> pd.DataFrame:
    """With the name of the run before those of groups, paths and blocks."""
    there = [column for column in PLACES if column in table]
    return table.assign(**{column: f"{name}/" + table[column].astype(str) for column in there})


def _same(runs: Mapping[str, Run], makings: Mapping[str, Mapping[str, Any]]) -> None:
    """Refuse runs that differ in what must be equal."""
    judged = [*MAY_DIFFER, *(f"seeing.{name}" for name in SEEING)]
    names = list(runs)
    for name in names[1:]:
        one, two = runs[names[0]].dataset, runs[name].dataset
        for what, a, b in (
            ("factors", one.names, two.names),
            ("labels", sorted(_targets(one)), sorted(_targets(two))),
            ("versions of stages", dict(one.stages), dict(two.stages)),
        ):
            if a != b:
                raise ModelError(f"runs {names[0]!r} and {name!r} have different {what}: {a}; {b}")
    groups = list(makings)
    for group in groups[1:]:
        a, b = (shared(makings[g], judged) for g in (groups[0], group))
        differ = sorted(_flat(a).items() ^ _flat(b).items())
        if differ:
            keys = sorted({key for key, _ in differ})
            raise ModelError(
                f"{groups[0]} and {group} were made with different {', '.join(keys)}: "
                "no model learns from both"
            )


def _targets(dataset: Dataset) -> set[str]:
    return {name for name in dataset.rows if name in TARGETS}


def _flat(making: Mapping[str, Any]) -> dict[str, str]:
    """A making with `seeing.name` and `units.name` for what lies below, values as text."""
    found: dict[str, str] = {}
    for name, value in making.items():
        below = value.items() if isinstance(value, Mapping) else [("", value)]
        found |= {f"{name}.{key}".rstrip("."): repr(one) for key, one in below}
    return found
