"""Findings made up for tests of the report: cheap, smooth, and with everything that can happen."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tilestream.label import disc_starts
from tilestream.model.registry import REGRESSORS
from tilestream.records import Float64
from tilestream.report import Findings, write_report
from tilestream.report.drives import DriveMeasured
from tilestream.report.evaluation import OPPONENTS

ORIGIN = (368_000.0, 3_950_000.0, 40.0)
LIMIT = 0.15
"""Threshold of the reports [m]."""
LENGTHS = {"I": 300, "II": 160}
HOSTILE = "</script><script>fail()</script><img src=x onerror=fail()> $$x$$ 'ö\"&amp;"


def places_of(lengths: dict[str, int], seed: int = 0) -> pd.DataFrame:
    """Routes side by side: smooth estimates, some missing, some outside of the domain."""
    rng = np.random.default_rng(seed)
    parts = []
    for k, (route, n) in enumerate(lengths.items()):
        step = np.arange(n, dtype=float)
        wave = np.sin(step / 17.0 + k) + 0.5 * np.sin(step / 5.0)
        estimate = 0.12 * np.exp(0.6 * wave + 0.05 * rng.normal(size=n))
        missing = rng.random(n) < 0.05 if n > 20 else np.zeros(n, bool)
        estimate[missing] = np.nan
        inside = rng.random(n) > 0.1
        parts.append(
            pd.DataFrame(
                {
                    "route_id": route,
                    "sample": np.arange(n),
                    "arc_length": step,
                    "heading": 0.0,
                    "x": ORIGIN[0] + step,
                    "y": ORIGIN[1] + 100.0 * k + 8.0 * np.sin(step / 30.0),
                    "z": ORIGIN[2],
                    "feature_count": rng.integers(1, 900, n).astype(float),
                    "estimate": estimate,
                    "low": estimate / 2.5,
                    "high": estimate * 2.5,
                    "p_fail": np.clip(estimate - 0.1, 0.0, 1.0),
                    "floor": 0.5 * estimate,
                    "tail": 0.5 * estimate,
                    "along": 0.8 * estimate,
                    "across": 0.5 * estimate,
                    "up": 0.2 * estimate,
                    "domain_distance": np.where(inside, 1.0, 9.0),
                    "in_domain": inside & ~missing,
                    "status": np.where(missing, "missing", "done"),
                    "reason": np.where(
                        missing, "no estimate: FDOP is not a number", "few features in view"
                    ),
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def labels_of(places: pd.DataFrame, groups: tuple[str, ...], seed: int = 1) -> pd.DataFrame:
    """Measured errors round the estimates, with a hole of 40 m in each path."""
    rng = np.random.default_rng(seed)
    known = places[places["estimate"].notna()]
    known = known[(known["arc_length"] < 60.0) | (known["arc_length"] > 100.0)]
    parts = []
    for group in groups:
        noise = np.exp(0.2 * rng.normal(size=len(known)))
        parts.append(
            pd.DataFrame(
                {
                    "group": group,
                    "path": known["route_id"].to_numpy(),
                    "block": known["route_id"].to_numpy() + "#00",
                    "sample": known["sample"].to_numpy(),
                    "arc_length": known["arc_length"].to_numpy(),
                    "error_mean": known["estimate"].to_numpy() * noise,
                    "held_out": known["estimate"].to_numpy() * 1.1,
                    "low": (0.5 * known["estimate"]).where(known["route_id"] == "I").to_numpy(),
                    "high": (2.0 * known["estimate"]).where(known["route_id"] == "I").to_numpy(),
                }
            )
        )
    return pd.concat(parts, ignore_index=True)


def judged_by(models: list[str], protocols: tuple[str, ...]) -> pd.DataFrame:
    """Rows of `evaluation.figures_by_protocol`; the last protocol cannot be followed."""
    rows: list[dict[str, Any]] = []
    for number, protocol in enumerate(protocols[:-1]):
        for k, model in enumerate(models):
            error = 0.01 * (number + 1) + 0.004 * k
            rows.append(
                {
                    "protocol": protocol, "model": model, "points": 400, "rmse": 1.5 * error,
                    "mae": error, "within_25mm": 0.6, "within_50mm": 0.9, "r2": 0.5, "skill": 0.4,
                    "spearman": 0.7 if k else float("nan"), "reason": "",
                    "skill_low": 0.31, "skill_high": 0.52, "segment_skill": 0.6,
                    "segment_spearman": 0.8, "segment_skill_low": 0.45,
                    "segment_skill_high": 0.72,
                }
            )  # fmt: skip
    rows.append({"protocol": protocols[-1], "reason": "one block only"})
    return pd.DataFrame(rows)


def cloud_around(x: float, y: float, z: float) -> Float64:
    """A road with two walls."""
    along, across = np.meshgrid(np.arange(-40.0, 40.0, 0.5), np.arange(-6.0, 6.0, 0.5))
    road = np.column_stack([along.ravel(), across.ravel(), np.full(along.size, -2.0)])
    wall = np.meshgrid(np.arange(-40.0, 40.0, 0.5), np.arange(-2.0, 12.0, 0.5))
    sides = [
        np.column_stack([wall[0].ravel(), np.full(wall[0].size, side), wall[1].ravel()])
        for side in (-9.0, 9.0)
    ]
    points: Float64 = np.concatenate([road, *sides]) + np.array([x, y, z])
    return points


def ends_of(group: str, sample: int) -> pd.DataFrame:
    """Starts of which those ahead fail and end at 1.5 m; the others end 5 cm to the left."""
    at = disc_starts()
    fail = at[:, 0] > 0.0
    along, across = np.where(fail, 1.5, 0.0), np.where(fail, 0.0, 0.05)
    return pd.DataFrame(
        {
            "group": group, "sample": sample, "from_along": at[:, 0], "from_across": at[:, 1],
            "along": along, "across": across, "error": np.hypot(along, across),
        }
    )  # fmt: skip


AGAIN = {
    "points": 480,
    "rmse": 0.02,
    "mae": 0.011,
    "within_25mm": 0.9,
    "within_50mm": 0.97,
    "r2": 0.9,
    "skill": 0.7,
    "spearman": float("nan"),
    "drives": 2,
    "limit": 0.79,
    "limit_low": 0.74,
    "limit_high": 0.83,
}
"""What a repeated drive knows."""


def whole(seed: int = 0) -> Findings:
    """Findings with every part filled in."""
    places = places_of(LENGTHS, seed)
    labels = labels_of(places, ("morning", "noon"))
    models = [*REGRESSORS, *OPPONENTS]
    table = pd.concat(
        [
            judged_by(["paper"], ("paper", "path", "blocks")).assign(factors=name)
            for name in ("FS", "FS+RQ", "FS+RQ+LY", "FS+RQ+LY+LS")
        ],
        ignore_index=True,
    )
    return Findings(
        title="Two streets",
        places=places,
        labels=labels,
        protocols=judged_by(models, ("paper", "path", "blocks")),
        table_iv=table,
        importances=pd.DataFrame(
            {
                "model": ["used", "used", "paper", "paper"],
                "factor": ["vd_mean", "ob_info_up", "bhatt_sim", "FDOP"],
                "criterion": ["OB", "OB", "LS", "LY"],
                "importance": [0.75, 0.25, 0.6, 0.4],
            }
        ),
        criterion_importances=pd.DataFrame(
            {
                "model": ["used", "paper", "paper"],
                "criterion": ["OB", "FS", "LS"],
                "factors": [2.0, 8.0, 4.0],
                "increase": [0.02, 0.004, 0.012],
                "spread": [0.003, 0.001, 0.002],
            }
        ),
        coverage=pd.DataFrame(
            {
                "path": ["", "I", "II"],
                "points": [480, 480, 220],
                "blocks": [2, 2, 1],
                "level": [0.9, 0.9, float("nan")],
                "covered": [0.93, 0.93, float("nan")],
                "error": [0.021, 0.021, float("nan")],
                "width": [0.14, 0.14, float("nan")],
            }
        ),
        parts=pd.concat(
            [
                judged_by(["corrected", "physics", "training median"], ("path", "blocks")).assign(
                    target=target
                )
                for target in ("error_tail", "across_mean", "p_fail")
            ],
            ignore_index=True,
        ),
        differences=pd.DataFrame(
            {
                "protocol": ["paper", "path", "path"],
                "points": 400,
                "mae": [0.02, 0.004, -0.001],
                "mae_low": [0.01, 0.001, -0.002],
                "mae_high": [0.03, 0.006, 0.002],
                "skill": [0.3, 0.05, -0.01],
                "skill_low": [0.2, 0.02, -0.04],
                "skill_high": [0.4, 0.09, 0.02],
                "target": ["error_mean", "error_mean", "error_tail"],
            }
        ),
        ceilings={"error_mean": AGAIN, "p_fail": AGAIN | {"mae": 0.021, "spearman": 0.81}},
        facts={
            "versions": {"tilestream": "0.1", "numpy": "2"},
            "seconds": 12.5,
            "lost": {},
            "nothing": float("inf"),
            "attributions": ["Buildings: somebody."],
        },
        notes={"job": ["the preset is not calibrated"]},
        drives=(DriveMeasured("morning", 500, 500, 480, 480, 480, {"after the last pose": 20}),),
        lost_labels=[{"reason": "label failed", "count": 3, "detail": "nothing near"}],
        crs="EPSG:32654",
        ends=ends_of,
        around=cloud_around,
    )


def without_labels() -> Findings:
    """What a run without a drive knows."""
    return Findings(title="No drive", places=places_of({"only": 80}))


def one_place() -> Findings:
    """The least that can be reported."""
    return Findings(title="One place", places=places_of({"spot": 1}), around=cloud_around)


def nothing_estimated() -> Findings:
    """Places without any estimate."""
    found = without_labels()
    return replace(found, places=found.places.assign(estimate=np.nan, reason="no map here"))


def hostile() -> Findings:
    """Names and reasons from files that are out to be run."""
    found = whole()
    places = found.places.replace({"route_id": {"I": HOSTILE}})
    labels = found.labels.replace({"path": {"I": HOSTILE}, "group": {"noon": HOSTILE}})
    return replace(
        found,
        title=HOSTILE,
        places=places.assign(reason=HOSTILE),
        labels=labels,
        protocols=found.protocols.replace({"reason": {"one block only": HOSTILE}}),
        table_iv=found.table_iv.replace({"factors": {"FS": HOSTILE}}),
        importances=found.importances.assign(factor=HOSTILE, criterion=HOSTILE),
        criterion_importances=found.criterion_importances.assign(criterion=HOSTILE),
        coverage=found.coverage.replace({"path": {"I": HOSTILE}}),
        around=None,
        facts={HOSTILE: {HOSTILE: HOSTILE}, "attributions": [HOSTILE]},
        notes={HOSTILE: [HOSTILE]},
        drives=(DriveMeasured(HOSTILE, 9, 9, 2, 2, 2, {HOSTILE: 7}),),
        lost_labels=[{"reason": HOSTILE, "count": 3, "detail": HOSTILE}],
    )


def written(make: Callable[[], Findings], folders: pytest.TempPathFactory) -> Path:
    """The folder of a report, written once for all tests."""
    if make not in _WRITTEN:
        folder = folders.mktemp("reports") / "new" / make.__name__
        write_report(make(), folder, threshold=LIMIT)
        _WRITTEN[make] = folder
    return _WRITTEN[make]


_WRITTEN: dict[Callable[[], Findings], Path] = {}
