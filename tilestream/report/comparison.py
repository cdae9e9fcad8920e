"""What a comparison of sensors, ranges and cell sizes says: of each, and where they part."""

from dataclasses import dataclass, field
from typing import Any

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
USUAL = 2.0
"""Cell size of the paper and of Autoware [m]: what a map of several sizes is compared with."""
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
    """`CELL_COLUMNS`; of every tile of the map at every cell size of the choices, and at `USUAL`
    where that fits the tiles."""
    facts: dict[str, Any] = field(default_factory=dict)
    """How it was made: settings by name."""
    notes: Notes = field(default_factory=dict)
    """What was noticed of the map and the routes, by source."""

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

    def by_choice(self, column: str) -> pd.DataFrame:
        """A column of the rows as a table: a row per sample point, a column per choice."""
        return _by_choice(self.rows, column)[self.choices["choice"].tolist()]

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
        known = self.by_choice("vd_mean").notna()
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

    def differing(self, count: int = 10) -> list[dict[str, Any]]:
        """Where the choices differ most, no two places near one another (`segments.APART`).

        Returns:
            The largest difference first: place, `best` and `worst` (of the choices that have an
            estimate there), their estimates and the difference [m]; no place where they agree.
        """
        estimate = self.by_choice("vd_mean")
        first = self.rows[self.rows["choice"] == self.choices["choice"].iloc[0]]
        places = first.set_index(["route_id", "sample"]).loc[estimate.index].reset_index()
        spread = (estimate.max(axis=1) - estimate.min(axis=1)).to_numpy(np.float64)
        places["estimate"] = np.where(spread > 0.0, spread, np.nan)
        found = []
        for row in worst_places(places, count):
            place, here = places.iloc[row], estimate.iloc[row]
            found.append(
                {name: place[name] for name in ("route_id", "arc_length", "x", "y", "z")}
                | {"best": here.idxmin(), "best_estimate": here.min()}
                | {"worst": here.idxmax(), "worst_estimate": here.max()}
                | {"difference": spread[row]}
            )
        return [dict(plain(place)) for place in found]

    def cell_sizes(self, cap: float) -> list[dict[str, Any]]:
        """For each vehicle that is compared with several cell sizes: one for each tile.

        A size suffices in a tile if it gives an estimate at every sample point there at which any
        size does, and the 95 % quantile of its estimates stays within the cap. The largest that
        suffices is chosen; where none does, the one that loses the fewest points and then has the
        lowest quantile; where there is no estimate, the smallest. Each estimate is that of
        a map of one cell size throughout.

        Args:
            cap: of the quantile [m].

        Returns:
            By vehicle: `vehicle`, `tiles` (a dictionary per tile of the map: `tile`, `places`,
            `cell_size` [m], `p95` [m] or None, `suffices`, None where nothing judges it, `cells`),
            `over`: those tiles where no size suffices; `cells` and `map_bytes` of the map of the
            chosen sizes, `finest_bytes` and `usual_bytes` (`USUAL`; None where that does not fit
            the tiles) of maps of one size.

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
            tiles = [
                {"tile": tile} | _size_of_tile(by_tile.get(tile), sizes, cap) for tile in size.index
            ]
            for line in tiles:
                line["cells"] = size.loc[line["tile"], line["cell_size"]]
            cells = int(sum(line["cells"] for line in tiles))
            found.append(
                {
                    "vehicle": vehicle,
                    "tiles": tiles,
                    "over": [line for line in tiles if line["suffices"] is False],
                    "cells": cells,
                    "map_bytes": cells * CELL_BYTES,
                    "finest_bytes": int(size[min(sizes)].sum()) * CELL_BYTES,
                    "usual_bytes": int(size[USUAL].sum()) * CELL_BYTES if USUAL in size else None,
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
                    "places": len(self.by_choice("vd_mean")),
                    "routes": list(dict.fromkeys(self.rows["route_id"])),
                    "choices": self.summaries(threshold),
                    "differing": self.differing(),
                    "cell_sizes": self.cell_sizes(cap),
                    "facts": self.facts,
                    "notes": self.notes,
                }
            )
        )


def _size_of_tile(rows: pd.DataFrame | None, sizes: dict[float, str], cap: float) -> dict[str, Any]:
    """The cell size of a tile, from the estimates at its sample points (None: it has none)."""
    finest = {"cell_size": min(sizes), "p95": None, "suffices": None}
    if rows is None:
        return {"places": 0} | finest
    estimate = _by_choice(rows, "vd_mean")
    estimated = estimate[estimate.notna().any(axis=1)]
    if estimated.empty:
        return {"places": len(estimate)} | finest
    ranked = []
    for cell_size, choice in sizes.items():
        here: Float64 = estimated[choice].dropna().to_numpy(np.float64)
        p95 = float(np.quantile(here, QUANTILE)) if here.size else np.inf
        ranked.append((len(estimated) - len(here), p95, cell_size))
    enough = [(lost, p95, cell) for lost, p95, cell in ranked if lost == 0 and p95 <= cap]
    _, p95, cell_size = max(enough, key=lambda r: r[2]) if enough else min(ranked)
    return {
        "places": len(estimate),
        "cell_size": cell_size,
        "p95": p95,
        "suffices": bool(enough),
    }


def _by_choice(rows: pd.DataFrame, column: str) -> pd.DataFrame:
    """A row per sample point, a column per choice, also of choices without any figure."""
    keys = ["route_id", "sample", "choice"]
    return rows.set_index(keys)[column].unstack()  # noqa: PD010 - a pivot_table drops those
