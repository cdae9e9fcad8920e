"""Real drives through four lidars: each lidar's own virtual drive against the measured errors.

    python benchmarks/drives.py --out FOLDER [--json FILE] [--model FILE] [LOG ...]

Every second scan of a log makes the map, the others are localized by the matcher `autoware`: as
recorded, and as three simpler lidars would have seen them. Nothing is fitted. Default: all
*/drive.mcap under TILESTREAM_DATA. Each log has its run directory in FOLDER; what is done there is
not done again. With --model also how often the intervals of that model hold.

In brackets 5 to 95 % of a bootstrap over blocks of about 15 m of a street, in which neighbouring
places are alike; a street has four or five of them, so its own brackets are rough.
"""

import argparse
import os
from pathlib import Path

HERE = Path(__file__).resolve().parent
DATA = Path(os.environ.get("TILESTREAM_DATA", HERE.parents[1] / "shared" / "data"))


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("logs", type=Path, nargs="*", help="logs of point clouds and poses")
    parser.add_argument("--out", type=Path, required=True, help="run directories; continues there")
    parser.add_argument("--json", type=Path, help="write all figures into this file too")
    parser.add_argument("--model", type=Path, help="a model whose intervals are judged too")
    parser.add_argument("--sensor", default="HDL64", help="the lidar of the logs")
    parser.add_argument("--height", type=float, default=1.73, help="of it above the road [m]")
    parser.add_argument("--range", type=float, default=80.0, help="how far the logs reach [m]")
    parser.add_argument("--set", action="append", default=[], help="of `observe`, e.g. starts=32")
    given = parser.parse_args()
    given.logs = given.logs or sorted(DATA.glob("*/drive.mcap"))
    if not given.logs or not all(log.exists() for log in given.logs):
        parser.error(f"no logs at {given.logs or DATA}: name some, or set TILESTREAM_DATA")
    return given


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
import yaml
from numpy.typing import NDArray
from scipy.stats import rankdata

import tilestream as ts
from tilestream.errors import PartialError
from tilestream.model.dataset import Dataset
from tilestream.model.file import load_model
from tilestream.model.prediction import predict
from tilestream.model.training import Model
from tilestream.pipeline.jobs.run import dataset_of
from tilestream.pipeline.jobs.train_over import as_read

LIDARS: dict[str, dict[str, float]] = {
    "as-recorded": {},
    "16-beams-30-m-blind": {"beams": 16, "range_max": 30.0, "blind_rear_deg": 120.0},
    "16-beams-20-m-blind": {"beams": 16, "range_max": 20.0, "blind_rear_deg": 180.0},
    "16-beams-15-m-blind": {"beams": 16, "range_max": 15.0, "blind_rear_deg": 180.0},
}
PARTS = {
    "mean": ("error_mean", "vd_mean"),
    "along": ("along_mean", "vd_along"),
    "across": ("across_mean", "vd_across"),
    "up": ("up_mean", "vd_up"),
    "floor": ("error_floor", "vd_floor"),
    "tail": ("error_tail", "vd_tail"),
    "p_fail": ("p_fail", "vd_p_fail"),
}
"""Label and estimate of each part of the error."""
RARE = ("tail", "p_fail")
"""Parts that are 0 at most places: their level is of means instead of medians."""
CM = 100.0
BLOCK = 15.0
"""Length of a block [m]."""
NEAR = 4.0
"""How far along the street a neighbouring scan may be [m]."""
ROUNDS = 500
"""Of the bootstrap."""
LEAST = 5
"""Fewest places of which a rank correlation is formed."""

Rows = NDArray[np.int64]
Figure = dict[str, float]
"""`value`, and `low` and `high` of its bootstrap."""


# --- Measured and estimated


def settings_of(log: Path, given: argparse.Namespace) -> ts.RunSettings:
    """The job of a log; the same settings continue the same run directory."""
    own = {key: yaml.safe_load(value) for key, value in (s.split("=", 1) for s in given.set)}
    mine = {"log": str(log), "every": 2, "offset": 1}
    return ts.RunSettings(
        out=str(given.out / street_of(log)),
        sensor=given.sensor,
        sensor_height=given.height,
        map={"sources": [str(log)], "every": 2},
        drives=[{"name": name, **mine, **lidar} for name, lidar in LIDARS.items()],
        observe={"range_max": given.range, **own},
        label={"matcher": "autoware"},
        model={"recipe": "physics", "offset": 0.0},
    )


def street_of(log: Path) -> str:
    """What a drive is called: its folder where all files have one name."""
    return log.resolve().parent.name if log.stem == "drive" else log.stem


def measured(given: argparse.Namespace) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Run what is not done yet.

    Returns:
        All places with label and estimate, with their `street`, `lidar` and `block`, in the order
        of the streets; and the labels that have no estimate.
    """
    tables, lost = [], []
    model = None if given.model is None else load_model(given.model)
    for log in given.logs:
        settings = settings_of(log, given)
        try:
            ts.run(settings)
        except PartialError as error:
            print(f"{street_of(log)}: {error}")
        found = dataset_of(settings.out)
        rows = found.rows.assign(street=street_of(log))
        if model is not None:
            rows = pd.concat([rows, said_by(model, settings, found)], axis=1)
        tables.append(rows)
        lost.append(found.lost.assign(street=street_of(log)))
    table = pd.concat(tables).rename(columns={"group": "lidar"})
    table = table.sort_values(["street", "lidar", "arc_length"], kind="stable", ignore_index=True)
    return table.assign(block=blocks(table, "street")), pd.concat(lost)


def blocks(table: pd.DataFrame, street: str) -> pd.Series:
    """Name of the block of each place: equal pieces of about `BLOCK` of the streets in a column."""
    arc = table.groupby(street)["arc_length"]
    begin, length = arc.transform("min"), arc.transform("max") - arc.transform("min")
    pieces = np.maximum(np.rint(length / BLOCK), 1)
    piece = np.minimum((table["arc_length"] - begin) / length.clip(lower=1.0) * pieces, pieces - 1)
    return table[street] + piece.astype(int).astype(str)


# --- Figures, with their bootstrap


def figure(table: pd.DataFrame, rows: Rows, value: Callable[[Rows], float]) -> Figure:
    """A figure of some rows, and how it varies with which blocks of street were driven."""
    if not len(rows):
        return dict.fromkeys(("value", "low", "high", "standard_error"), float("nan"))
    blocks = table["block"].to_numpy(str)[rows]
    parts = [rows[blocks == block] for block in np.unique(blocks)]
    rng = np.random.default_rng(0)
    drawn = [
        value(np.concatenate([parts[k] for k in rng.integers(0, len(parts), len(parts))]))
        for _ in range(ROUNDS)
    ]
    drawn = [one for one in drawn if np.isfinite(one)] or [np.nan]
    low, high = np.quantile(drawn, (0.05, 0.95))
    found = {"value": value(rows), "low": float(low), "high": float(high)}
    return found | {"standard_error": float(np.std(drawn)), "places": len(rows)}


def spearman(x: NDArray[np.float64], y: NDArray[np.float64]) -> float:
    """Rank correlation; NaN where there are few places, or all alike."""
    good = np.isfinite(x) & np.isfinite(y)
    if good.sum() < LEAST or np.ptp(x[good]) == 0.0 or np.ptp(y[good]) == 0.0:
        return float("nan")
    return float(np.corrcoef(rankdata(x[good]), rankdata(y[good]))[0, 1])


class Judged:
    """The figures of a table of places."""

    def __init__(self, table: pd.DataFrame) -> None:
        """Take the table of `measured`."""
        self.table = table
        self.numbers = {
            name: table[name].to_numpy(np.float64) for pair in PARTS.values() for name in pair
        }
        self.numbers["neighbours"] = neighbours(table)

    def rows(self, **wanted: str) -> Rows:
        """The rows of a street, of a lidar, of both, or all."""
        chosen = np.ones(len(self.table), np.bool_)
        for column, name in wanted.items():
            chosen &= (self.table[column] == name).to_numpy()
        return np.flatnonzero(chosen)

    def ranks(self, estimate: str, measured_as: str, **wanted: str) -> Figure:
        """Spearman of two columns."""
        x, y = self.numbers[estimate], self.numbers[measured_as]
        return figure(self.table, self.rows(**wanted), lambda rows: spearman(x[rows], y[rows]))

    def order(self, **wanted: str) -> Figure:
        """Mean Spearman of the order of the lidars at the places that all of them have."""
        label, estimate = PARTS["mean"]
        some = self.table.iloc[self.rows(**wanted)]
        places = some.groupby(["street", "sample"]).filter(lambda p: len(p) == len(LIDARS))
        rho = {
            int(place.index[0]): np.corrcoef(rankdata(place[label]), rankdata(place[estimate]))[
                0, 1
            ]
            for _, place in places.groupby(["street", "sample"])
        }
        first = np.array(list(rho), np.int64)
        return figure(self.table, first, lambda rows: float(np.mean([rho[row] for row in rows])))

    def within(self, value: Callable[[Callable[[str], float]], float]) -> Figure:
        """Mean over lidars and streets of what is said of the rank correlations of columns with the
        measured error inside each.
        """
        groups = self.table.groupby(["street", "lidar"]).ngroup().to_numpy()
        label = self.numbers[PARTS["mean"][0]]

        def mean(rows: Rows) -> float:
            parts = [rows[groups[rows] == group] for group in np.unique(groups[rows])]
            each = [
                value(lambda name, p=p: spearman(self.numbers[name][p], label[p])) for p in parts
            ]
            return float(np.nanmean(each)) if np.isfinite(each).any() else float("nan")

        return figure(self.table, self.rows(), mean)

    def level(self, part: str, **wanted: str) -> Figure:
        """Measured / estimated, with both [m, or a share]."""
        label, estimate = (self.numbers[name] for name in PARTS[part])
        middle = np.mean if part in RARE else np.median
        rows = self.rows(**wanted)

        def ratio(some: Rows) -> float:
            below = float(middle(estimate[some]))
            return float(middle(label[some])) / below if below > 0.0 else float("nan")

        both = {"measured": label[rows], "estimated": estimate[rows]}
        middles = {name: float(middle(x)) if len(x) else float("nan") for name, x in both.items()}
        return middles | figure(self.table, rows, ratio)


def neighbours(table: pd.DataFrame) -> NDArray[np.float64]:
    """(n,) the error at each place as the scans before and after tell it, interpolated between
    them, or that of the one that is near [m]; NaN: none is.
    """
    found = np.full(len(table), np.nan)
    for _, street in table.groupby(["street", "lidar"]):
        arc, error = street["arc_length"].to_numpy(), street["error_mean"].to_numpy()
        for k, row in enumerate(street.index):
            near = [j for j in (k - 1, k + 1) if 0 <= j < len(arc) and abs(arc[j] - arc[k]) <= NEAR]
            if near:
                found[row] = np.interp(arc[k], arc[near], error[near])
    return found


def said_by(model: Model, settings: ts.RunSettings, found: Dataset) -> pd.DataFrame:
    """What a model says of the places of a dataset, each as its lidar sees them: `said`, `low` and
    `high` [m], `in_domain`.
    """
    makings, rows = as_read(settings), found.averaged(model.width).rows
    parts = [predict(model, part, makings[group]) for group, part in rows.groupby("group")]
    said = pd.concat(parts).loc[rows.index].rename(columns={"estimate": "said"})
    return said[["said", "low", "high", "in_domain"]]


def intervals(table: pd.DataFrame) -> dict[str, dict[str, dict[str, Figure]]]:
    """By street, then by lidar (`all`: all): share of the places in the model's interval, and
    unlike its training, and how large the estimates and the errors are.
    """
    error = table["error_mean"]
    said, actual = table["said"].to_numpy(np.float64), error.to_numpy(np.float64)
    held = ((table["low"] <= error) & (error <= table["high"])).to_numpy(np.float64)
    strange = (~table["in_domain"].astype(bool)).to_numpy(np.float64)
    done, off = table["said"].notna().to_numpy(), (table["said"] - error).abs().to_numpy()
    found: dict[str, dict[str, dict[str, Figure]]] = {}
    for street in ("all", *dict.fromkeys(table["street"])):
        there = done if street == "all" else done & (table["street"] == street).to_numpy()
        found[street] = {}
        for lidar in ("all", *LIDARS):
            own = there if lidar == "all" else there & (table["lidar"] == lidar).to_numpy()
            rows = np.flatnonzero(own)
            found[street][lidar] = {
                "held": figure(table, rows, lambda some: float(held[some].mean())),
                "out_of_domain": figure(table, rows, lambda some: float(strange[some].mean())),
                "off": figure(table, rows, lambda some: float(off[some].mean())),
                "spearman": figure(table, rows, lambda some: spearman(said[some], actual[some])),
                "estimated": {"value": float(np.median(said[rows]))},
                "measured": {"value": float(np.median(actual[rows]))},
            }
    return found


def figures(table: pd.DataFrame, lost: pd.DataFrame) -> dict[str, Any]:
    """All figures, by name."""
    judged = Judged(table)
    label, estimate = PARTS["mean"]
    streets = {street: {"street": street} for street in dict.fromkeys(table["street"])}
    parts: dict[str, dict[str, str]] = {"all": {}, **streets}
    found: dict[str, Any] = {
        "places": len(table),
        "lost": {str(key): int(count) for key, count in lost["reason"].value_counts().items()},
        "pooled": {name: judged.ranks(estimate, label, **which) for name, which in parts.items()},
        "order": {name: judged.order(**which) for name, which in parts.items()},
        "level": {
            name: {
                lidar: {part: judged.level(part, lidar=lidar, **which) for part in PARTS}
                for lidar in LIDARS
            }
            for name, which in parts.items()
        },
        "within": {
            street: {
                lidar: {
                    "estimate": judged.ranks(estimate, label, lidar=lidar, **which),
                    "neighbours": judged.ranks("neighbours", label, lidar=lidar, **which),
                }
                for lidar in LIDARS
            }
            for street, which in streets.items()
        },
        "within_mean": {
            "estimate": judged.within(lambda each: each(estimate)),
            "neighbours": judged.within(lambda each: each("neighbours")),
            "difference": judged.within(lambda each: each(estimate) - each("neighbours")),
        },
    }
    if "said" in table:
        found["model"] = intervals(table)
    return found


# --- In words


def told(one: Figure) -> str:
    """A figure with its bootstrap."""
    if not np.isfinite(one["value"]):
        return "-"
    return "{value:.2f} ({low:.2f} to {high:.2f})".format(**one)


def show(title: str, names: str, rows: list[tuple[str, ...]]) -> None:
    """Print a table as Markdown."""
    lines = [head := names.split(", "), ["---"] * len(head), *rows]
    print(f"\n### {title}\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines))


def level_told(part: str, one: Figure) -> str:
    """Measured, estimated and their ratio."""
    if not np.isfinite(one["measured"]):
        return "-"
    scale, digits = (1.0, 3) if part == "p_fail" else (CM, 1)
    both = (f"{scale * one[name]:.{digits}f}" for name in ("measured", "estimated"))
    return " / ".join(both) + (f": {one['value']:.2f}" if np.isfinite(one["value"]) else "")


def tell(found: dict[str, Any]) -> None:
    """Print all figures."""
    print(f"\n{found['places']} places; labels without an estimate: {found['lost'] or 'none'}")
    rows = [
        (name, str(one.get("places", 0)), told(one), told(found["order"][name]))
        for name, one in found["pooled"].items()
    ]
    show(
        "Rank correlation of measured and estimated mean error",
        "street, places, pooled over lidars, order of the lidars at a place",
        rows,
    )
    for name, lidars in found["level"].items():
        lines = [
            (lidar, *(level_told(part, parts[part]) for part in PARTS), told(parts["mean"]))
            for lidar, parts in lidars.items()
        ]
        show(
            f"Level, {name}: measured / estimated [cm; p_fail: share]: ratio",
            f"lidar, {', '.join(PARTS)}, ratio of mean",
            lines,
        )
    lines = [
        (street, lidar, *(told(both[what]) for what in ("estimate", "neighbours")))
        for street, lidars in found["within"].items()
        for lidar, both in lidars.items()
    ]
    means = (told(found["within_mean"][what]) for what in ("estimate", "neighbours"))
    lines.append(("mean", f"difference {told(found['within_mean']['difference'])}", *means))
    show("Within one lidar and street", "street, lidar, Spearman, neighbouring scans", lines)
    if "model" in found:
        lines = [
            (
                street,
                lidar,
                f"{CM * one['measured']['value']:.1f} / {CM * one['estimated']['value']:.1f}",
                f"{CM * one['off']['value']:.1f}",
                f"{one['held']['value']:.0%} +- {one['held']['standard_error']:.0%}",
                f"{one['out_of_domain']['value']:.0%}",
            )
            for street, lidars in found["model"].items()
            for lidar, one in lidars.items()
        ]
        names = "street, lidar, median measured / estimated [cm], off by [cm], held, out of domain"
        show("The model's 90 % intervals", names, lines)


def main(given: argparse.Namespace) -> None:
    """Run, judge, print."""
    table, lost = measured(given)
    found = figures(table, lost)
    tell(found)
    if given.json:
        given.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main(GIVEN)
