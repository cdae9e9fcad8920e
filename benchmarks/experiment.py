"""The tables of a finished run for RESULTS.md: Table I, Table IV, protocols, ceiling, cost.

    tilestream run pipelines/shinjuku.yaml
    python benchmarks/experiment.py shinjuku

Everything is read from the run directory; nothing is computed anew. Lengths are centimetres.
"""

import argparse
from pathlib import Path


def options() -> argparse.Namespace:
    """What the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run_dir", type=Path)
    return parser.parse_args()


if __name__ == "__main__":
    GIVEN = options()  # before what is slow to import

import json
from typing import Any

import pandas as pd
from shinjuku_labels import TABLE_ONE, markdown, table_one

import tilestream as ts
from tilestream.model.evaluation import PAPER_TABLE
from tilestream.model.splits import PROTOCOLS

CM = 100.0
FIRST = 12
"""Factors of each forest that are listed."""
TITLES = {protocol.name: protocol.name for protocol in PROTOCOLS} | {
    "paper": "random quarter (the paper's)",
    "path": "a path left out",
    "blocks": "blocks left out",
}


def table_one_by_drive(run_dir: Path) -> str:
    """Shares of sample points beyond each limit, ours and the paper's, by drive."""
    rows = ts.dataset(run_dir)
    lines = []
    for drive, part in rows.assign(drive=rows["group"].str.split("-").str[0]).groupby("drive"):
        lines += [[str(drive), *row] for row in table_one(part)]
    return markdown(lines, ["drive", *TABLE_ONE])


def figures(row: Any) -> list[str]:
    """The figures of a row of the evaluation."""
    lengths = [f"{CM * row[name]:.2f}" for name in ("rmse", "mae")]
    shares = [f"{CM * row[name]:.1f} %" for name in ("within_25mm", "within_50mm")]
    rest = [
        spanned(row, name)
        for name in ("r2", "skill", "spearman", "segment_skill", "segment_spearman")
    ]
    return [*lengths, *shares, *rest]


def spanned(row: Any, name: str) -> str:
    """A figure, with its 90 % interval where there is one."""
    if pd.isna(row.get(name)):
        return ""
    ends = [row.get(f"{name}_{end}") for end in ("low", "high")]
    span = "" if any(map(pd.isna, ends)) else f" ({ends[0]:.2f} to {ends[1]:.2f})"
    return f"{row[name]:.2f}{span}"


FIGURES = ["RMSE", "MAE", "< 2.5 cm", "< 5 cm", "R^2", "skill", "Spearman"]
FIGURES += ["skill, 12 m", "Spearman, 12 m"]


def table_four(evaluation: dict[str, Any]) -> str:
    """The paper's Table IV beside ours on every protocol."""
    lines = [["the paper", str(row["factors"]), *figures(row)] for _, row in PAPER_TABLE.iterrows()]
    table = pd.DataFrame(evaluation["table_iv"])
    for protocol, part in table[table["reason"] == ""].groupby("protocol", sort=False):
        for _, row in part.iterrows():
            name = f"{TITLES[str(protocol)]}, forest `{row['model']}`"
            lines.append([name, str(row["factors"]), *figures(row)])
    return markdown(lines, ["protocol", "factors", *FIGURES])


def table_protocols(evaluation: dict[str, Any], target: str = "error_mean") -> str:
    """Models, opponents and the repeated drive on every protocol."""
    main = target == "error_mean"
    table = pd.DataFrame(evaluation["protocols" if main else "parts"])
    if not main:
        table = table[table["target"] == target]
    lines = []
    for protocol, part in table[table["reason"] == ""].groupby("protocol", sort=False):
        ranked = part.sort_values("mae")
        lines += [
            [TITLES[str(protocol)], str(r["model"]), *figures(r)] for _, r in ranked.iterrows()
        ]
    if target in evaluation["ceilings"]:
        known = evaluation["ceilings"][target]
        blank = [""] * len(FIGURES)
        blank[FIGURES.index("skill")] = spanned(known, "limit")
        lines.append(["", "a repeated drive", *figures(known)])
        lines.append(["", "the mean of all drives there could be", *blank])
    return markdown(lines, ["protocol", "model", *FIGURES])


def table_importances(run_dir: Path) -> str:
    """How much each criterion and each factor matters, to the forest in use and to the paper's."""
    weights = pd.read_parquet(run_dir / "tables" / "judged" / "weights.parquet")
    criteria = weights[weights["factor"] == ""]
    permuted = [
        [
            str(row["model"]),
            str(row["criterion"]),
            f"{row['factors']:.0f}",
            f"{CM * row['increase']:.2f} ± {CM * row['spread']:.2f}",
        ]
        for _, row in criteria.iterrows()
    ]
    own = weights[weights["factor"] != ""].sort_values(["model", "importance"], ascending=False)
    first = own.groupby("model", sort=False).head(FIRST)
    shares = [
        [str(row["model"]), str(row["factor"]), f"{row['importance']:.3f}"]
        for _, row in first.iterrows()
    ]
    head = ["forest", "criterion", "factors", "permuted on held-out blocks, MAE grows by"]
    return f"{markdown(permuted, head)}\n\n{markdown(shares, ['forest', 'factor', 'importance'])}"


def table_cost(run: dict[str, Any]) -> str:
    """What each stage cost."""
    lines = [
        [stage, f"{row['tasks']:,}", f"{row['work']:,}", f"{row['core_seconds']:,.0f}"]
        for stage, row in run["stages"].items()
    ]
    return markdown(lines, ["stage", "tasks", "work", "core-seconds"])


def main(given: argparse.Namespace) -> None:
    """Print the tables of a run directory."""
    evaluation = json.loads((given.run_dir / "tables" / "evaluation.json").read_text())
    run = json.loads((given.run_dir / "run.json").read_text())
    print(f"## Errors\n\n{table_one_by_drive(given.run_dir)}\n")
    print(f"## Table IV\n\n{table_four(evaluation)}\n")
    print(f"## Protocols\n\n{table_protocols(evaluation)}\n")
    for target in dict.fromkeys(row["target"] for row in evaluation["parts"]):
        print(f"## {target}\n\n{table_protocols(evaluation, target)}\n")
    print(f"## Importances\n\n{table_importances(given.run_dir)}\n")
    coverage = pd.DataFrame(evaluation["coverage"])
    lines = [
        [
            str(r.path) or "all",
            str(r.points),
            *(
                ["none: no two blocks elsewhere", "", ""]
                if pd.isna(r.level)
                else [f"{CM * r.level:.0f} %", f"{CM * r.covered:.0f} %", f"{CM * r.width:.1f}"]
            ),
        ]
        for r in coverage.itertuples()
    ]
    print(
        "## Intervals\n\n"
        + markdown(lines, ["path", "points", "promised", "covered", "mean width [cm]"])
    )
    print(f"\n## Cost\n\n{table_cost(run)}\n\n{run['seconds']:.0f} s in all")


if __name__ == "__main__":
    main(GIVEN)
