"""What a comparison of sensors, ranges and cell sizes says: of each, and where they part."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from tilestream.errors import UsageError
from tilestream.notes import Notes
from tilestream.records import Float64
from tilestream.report.segments import check_threshold, worst_places
from tilestream.report.summary import by_reason, plain, quantiles
from tilestream.version import VERSION

ROW_COLUMNS = (
    "choice", "route_id", "sample", "arc_length", "x", "y", "z", "above_ground", "tile",
    "vd_mean", "vd_p_fail", "vd_along", "vd_across", "status", "reason",
)  # fmt: skip
"""A row per choice and sample point: place [m], tile, what the virtual drive estimates [m, 1]."""
CHOICE_COLUMNS = (
    "choice", "vehicle", "sensor", "range_max", "blind_rear_deg", "scan_leaf", "cell_size",
)  # fmt: skip
"""A row per choice; choices of one `vehicle` differ in the cell size only [m, deg]."""
CELL_COLUMNS = ("tile", "cell_size", "cells")
"""A row per tile of the map and cell size [m]: how many cells it has."""
CELL_BYTES = 13 * 8
"""A cell in memory: index (3), count, mean (3), six numbers of the covariance, 8 bytes each."""
QUANTILE = 0.95
"""Of the estimates in a tile: this one must stay within the cap."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The virtual drive along the same routes, as each of several choices.

    Raises:
        UsageError: a table without rows or of other columns, rows of a choice that is not listed,
            choices of other sample points.
    """

    rows: pd.DataFrame
    """`ROW_COLUMNS`; choice by choice as in `choices`, route by route and along each."""
    choices: pd.DataFrame
    """`CHOICE_COLUMNS`."""
    cells: pd.DataFrame
    """`CELL_COLUMNS`; of every tile of the map at every cell size of the choices."""
    facts: dict[str, Any] = field(default_factory=dict)
    """How it was made: settings by name."""
    notes: Notes = field(default_factory=dict)
    """What was noticed of the map and the routes, by source."""
    worth: tuple[str, ...] = ()
    """What its figures are worth, as sentences."""

    def __post_init__(self) -> None:
        wanted = {"rows": ROW_COLUMNS, "choices": CHOICE_COLUMNS, "cells": CELL_COLUMNS}
        for name, columns in wanted.items():
            table = getattr(self, name)
            if tuple(table) != columns or table.empty:
                raise UsageError(f"{name}: give rows of the columns {', '.join(columns)}")
        strange = set(self.rows["choice"]) ^ set(self.choices["choice"])
        if strange:
            raise UsageError(f"rows and choices do not agree on {', '.join(sorted(strange))}")
        if len(set(self.rows.groupby("choice").size())) > 1:
            raise UsageError("rows: give every choice the same sample points")

    @property
    def estimates(self) -> pd.DataFrame:
        """The estimates [m] as a table: a row per sample point, a column per choice."""
        return _by_choice(self.rows)[self.choices["choice"].tolist()]

    def summaries(self, threshold: float) -> list[dict[str, Any]]:
        """The figures of each choice.

        Args:
            threshold: estimates above this are too large [m].

        Returns:
            By choice: `CHOICE_COLUMNS`; `places`, `estimated`; `median`, `p95`, `max` [m],
            `over_share` and `p_fail` of its own estimates, None where it has none; `missing` by
            reason, the commonest first; `lost`: places that another choice estimates and it does
            not; `cells` and `map_bytes` of the whole map at its cell size.

        Raises:
            UsageError: a threshold that is no positive length.
        """
        check_threshold(threshold)
        known = self.estimates.notna()
        any_knows = known.any(axis=1)
        size = self.cells.groupby("cell_size")["cells"].sum()
        found = []
        for choice in self.choices.to_dict("records"):
            part = self.rows[self.rows["choice"] == choice["choice"]]
            here = part["vd_mean"].dropna().to_numpy(np.float64)
            cells = int(size[choice["cell_size"]])
            figures = {
                "places": len(part),
                "estimated": len(here),
                **quantiles(here),
                "over_share": float((here > threshold).mean()) if here.size else None,
                "p_fail": float(part["vd_p_fail"].mean()) if here.size else None,
                "missing": by_reason(part.loc[part["vd_mean"].isna(), "reason"]),
                "lost": int((any_knows & ~known[choice["choice"]]).sum()),
                "cells": cells,
                "map_bytes": cells * CELL_BYTES,
            }
            found.append(dict(choice) | figures)
        return [dict(plain(figures)) for figures in found]

    def differing(self) -> list[dict[str, Any]]:
        """Where the choices differ most, no two places near one another (`segments.APART`).

        Returns:
            The largest difference first: place, `best` and `worst` (of the choices that have an
            estimate there), their estimates and the difference [m]; no place where they agree.
        """
        estimate = self.estimates
        first = self.rows[self.rows["choice"] == self.choices["choice"].iloc[0]]
        places = first.set_index(["route_id", "sample"]).loc[estimate.index].reset_index()
        spread = (estimate.max(axis=1) - estimate.min(axis=1)).to_numpy(np.float64)
        places["estimate"] = np.where(spread > 0.0, spread, np.nan)
        found = []
        for row in worst_places(places):
            place, here = places.iloc[row], estimate.iloc[row]
            found.append(
                {name: place[name] for name in ("route_id", "arc_length", "x", "y", "z")}
                | {"best": here.idxmin(), "best_estimate": here.min()}
                | {"worst": here.idxmax(), "worst_estimate": here.max()}
                | {"difference": spread[row]}
            )
        return [dict(plain(place)) for place in found]

    def cell_sizes(self, cap: float) -> list[dict[str, Any]]:
        """For each vehicle that is compared with several cell sizes: what each costs, and one for
        each tile.

        No size is right by being small: the first of a vehicle's choices is its baseline, and the
        others are compared with that. A size suffices in a tile if it gives an estimate at every
        sample point there at which any size does, and the 95 % quantile of its estimates stays
        within the cap. Of those that suffice the one with the fewest cells there is chosen; where
        none does, the one that loses the fewest points and then has the lowest quantile; where
        there is no estimate, the baseline; of equals the first. Each estimate is that of a map of
        one cell size throughout.

        Args:
            cap: of the quantile [m].

        Returns:
            By vehicle: `vehicle`, `baseline` [m]; `sizes` (a dictionary per size: `cell_size` [m],
            `cells` and `map_bytes` of a map of it alone, `change`: the median over places of its
            estimate - the baseline's [m], None where they share none, `worse`: the share of these
            places where that is above 0, `suffices`: in how many of the `with_estimates` tiles);
            `tiles` (a dictionary per tile of the map: `tile`, `places`, `cell_size` [m], `p95` [m]
            or None, `suffices`, None where nothing judges it, `cells`), `over`: those tiles where
            no size suffices; `cells` and `map_bytes` of the map of the chosen sizes.

        Raises:
            UsageError: a cap that is no positive length.
        """
        check_threshold(cap)
        size = self.cells.set_index(["tile", "cell_size"])["cells"].unstack()  # noqa: PD010
        found = []
        for vehicle, choices in self.choices.groupby("vehicle", sort=False):
            if len(choices) < 2:
                continue
            sizes = dict(zip(choices["cell_size"], choices["choice"], strict=True))
            rows = self.rows[self.rows["choice"].isin(choices["choice"])]
            by_tile = dict(iter(rows.groupby("tile")))
            judged = {tile: _judged(by_tile.get(tile), sizes, cap) for tile in size.index}
            tiles = [{"tile": t} | _chosen(judged[t], size.loc[t], sizes) for t in size.index]
            cells = int(sum(line["cells"] for line in tiles))
            found.append(
                {
                    "vehicle": vehicle,
                    "baseline": next(iter(sizes)),
                    "sizes": _costs(rows, sizes, size, judged.values()),
                    "with_estimates": sum(bool(one.ranked) for one in judged.values()),
                    "tiles": tiles,
                    "over": [line for line in tiles if line["suffices"] is False],
                    "cells": cells,
                    "map_bytes": cells * CELL_BYTES,
                }
            )
        return [dict(plain(vehicle)) for vehicle in found]

    def content(self, threshold: float, cap: float) -> dict[str, Any]:
        """Everything as plain values, for machines and for the page alike; arguments as above."""
        return dict(
            plain(
                {
                    "tilestream": VERSION,
                    "threshold": threshold,
                    "cap": cap,
                    "places": len(self.estimates),
                    "worth": {"warnings": [], "told": self.worth},
                    "routes": list(dict.fromkeys(self.rows["route_id"])),
                    "choices": self.summaries(threshold),
                    "differing": self.differing(),
                    "cell_sizes": self.cell_sizes(cap),
                    "facts": self.facts,
                    "notes": self.notes,
                }
            )
        )


class _Judged(NamedTuple):
    """The cell sizes of a tile, by the estimates at its sample points."""

    places: int
    ranked: dict[float, tuple[int, float]]
    """By size: places that it loses, and the quantile of its estimates; empty: nothing judges."""
    enough: list[float]
    """The sizes that suffice."""


def _judged(rows: pd.DataFrame | None, sizes: dict[float, str], cap: float) -> _Judged:
    """What the estimates of a tile (None: it has no sample points) say of each size."""
    if rows is None:
        return _Judged(0, {}, [])
    estimate = _by_choice(rows)
    estimated = estimate[estimate.notna().any(axis=1)]
    if estimated.empty:
        return _Judged(len(estimate), {}, [])
    ranked = {}
    for cell_size, choice in sizes.items():
        here: Float64 = estimated[choice].dropna().to_numpy(np.float64)
        p95 = float(np.quantile(here, QUANTILE)) if here.size else np.inf
        ranked[cell_size] = len(estimated) - len(here), p95
    enough = [size for size, (lost, p95) in ranked.items() if lost == 0 and p95 <= cap]
    return _Judged(len(estimate), ranked, enough)


def _chosen(judged: _Judged, cells: pd.Series, sizes: dict[float, str]) -> dict[str, Any]:
    """The cell size of a tile, which has so many cells at each."""
    if judged.enough:
        size = min(judged.enough, key=lambda size: cells[size])
    elif judged.ranked:
        size = min(judged.ranked, key=lambda size: judged.ranked[size])
    else:
        size = next(iter(sizes))
    return {
        "places": judged.places,
        "cell_size": size,
        "p95": judged.ranked[size][1] if judged.ranked else None,
        "suffices": bool(judged.enough) if judged.ranked else None,
        "cells": cells[size],
    }


def _costs(
    rows: pd.DataFrame, sizes: dict[float, str], cells: pd.DataFrame, judged: Iterable[_Judged]
) -> list[dict[str, Any]]:
    """What each cell size costs: in cells, and in error against the baseline, the first."""
    estimate = _by_choice(rows)
    baseline = estimate[next(iter(sizes.values()))]
    suffices = Counter(size for one in judged for size in one.enough)
    found = []
    for size, choice in sizes.items():
        change = (estimate[choice] - baseline).dropna().to_numpy(np.float64)
        total = int(cells[size].sum())
        found.append(
            {
                "cell_size": size,
                "cells": total,
                "map_bytes": total * CELL_BYTES,
                "change": float(np.median(change)) if change.size else None,
                "worse": float((change > 0.0).mean()) if change.size else None,
                "suffices": suffices[size],
            }
        )
    return found


def _by_choice(rows: pd.DataFrame) -> pd.DataFrame:
    """Estimates: a row per sample point, a column per choice, also of choices without any."""
    keys = ["route_id", "sample", "choice"]
    return rows.set_index(keys)["vd_mean"].unstack()  # noqa: PD010 - a pivot_table drops those
