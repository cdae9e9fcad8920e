"""What would mend a poor stretch: the virtual drive with each remedy, and honest words."""

import errno
import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scenes import PLACES

import tilestream as ts
from tilestream.apps import advise as advising
from tilestream.apps.advise import OF_REMEDIES
from tilestream.apps.choices import Choice
from tilestream.apps.remedies import FIRST_GUESS, remedies_of
from tilestream.cli import run as command
from tilestream.errors import UsageError
from tilestream.files import Files
from tilestream.formats.points.pcd import write_pcd
from tilestream.grid import TileGrid
from tilestream.matcher import RegistrationSettings
from tilestream.pipeline.jobs.run_folder import rows_of
from tilestream.pipeline.stages.observe import Observing
from tilestream.sensor import Mount, Vehicle
from tilestream.settings import VirtualSettings

Told = pytest.CaptureFixture[str]
LIDAR = ts.VLP16.model_copy(update={"name": "short", "azimuth_step_deg": 4.0, "range_max": 16.0})
NOW = Observing(
    ts.VLP16,
    VirtualSettings(range_max=60.0, blind_rear_deg=90.0),
    RegistrationSettings(),
    cell_size=2.0,
    sensor_height=2.0,
)
GRID = TileGrid.of(20.0, 1.0)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Estimates along a street, by a lidar whose range and view are cut."""
    folder = tmp_path_factory.mktemp("advise")
    write_pcd(folder / "street.pcd", PLACES["canyon"](np.random.default_rng(3), 40.0, 0.3))
    ts.ingest(folder / "street.pcd", folder / "map.zarr", tile_size=20.0)
    (folder / "route.csv").write_text("x,y\n4,0\n30,0\n")
    job = ts.RunSettings(
        out=str(folder / "run"),
        map={"store": str(folder / "map.zarr")},
        routes=[str(folder / "route.csv")],
        spacing=2.0,
        sensor=LIDAR.model_dump(),
        observe={"starts": 8, "draws": 2, "worlds": 1, "range_max": 12.0, "blind_rear_deg": 90.0},
        model={"recipe": "physics", "offset": 0.0},
    )
    ts.run(job)
    return folder / "run"


def low(run: Path) -> float:
    """A threshold that half of the estimates are above."""
    return float(ts.read_run(run)["estimate"].median())


def test_a_remedy_that_changes_nothing_gives_the_drives_of_the_run(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[pd.DataFrame] = []

    def none(now: Observing, _: TileGrid) -> tuple[Mapping[str, Choice], Mapping[str, str]]:
        same = Choice(now.sensor, now.seeing.range_max, now.seeing.blind_rear_deg, now.cell_size)
        return {"none": same}, {}

    def effect(now: pd.DataFrame, after: pd.DataFrame) -> dict[str, Any]:
        seen.append(after)
        return told(now, after)

    told = advising._effect
    monkeypatch.setattr(advising, "remedies_of", none)
    monkeypatch.setattr(advising, "_effect", effect)
    found = ts.advise(run, tmp_path / "tables", threshold=low(run))
    of_run = rows_of(run, "observability")
    assert of_run is not None
    known = of_run.set_index(advising.PLACE)[advising.OF_DRIVE]
    for table in seen[::2]:
        pd.testing.assert_frame_equal(table, known.reindex(table.index), check_exact=True)
    same = found.remedies[found.remedies["remedy"] == "none"]
    assert same["virtual_after_m"].tolist() == same["virtual_now_m"].tolist()
    assert same["after_m"].tolist() == pytest.approx(found.stretches["now_m"].tolist())
    assert not same["helps"].any()


def test_stretches_are_those_over_the_threshold(run: Path) -> None:
    found = ts.advise(run, threshold=low(run))
    table, stretches = ts.read_run(run), found.stretches
    over = table[table["estimate"] > found.threshold]
    inside = sum(
        over["arc_length"].between(row["begin_m"], row["end_m"])
        for row in stretches.to_dict("records")
    )
    assert (inside == 1).all()
    assert (stretches["places"] <= advising.MOST).all()
    tried = set(found.remedies["remedy"])
    assert tried == {
        "cells of 1 m", "the whole range of 16 m", "no blind sector", "VLP16", "HDL64", "OS1_128",
        FIRST_GUESS,
    }  # fmt: skip
    assert len(found.remedies) == len(tried) * len(stretches)
    for number, row in enumerate(stretches.to_dict("records")):
        of = found.remedies[found.remedies["stretch"] == number]
        helping = of[of["helps"]]
        assert (row["best"] == "") is helping.empty
        if len(helping):
            assert row["best_m"] == helping["after_m"].min()
            assert row["mends"] is bool(row["best_m"] <= found.threshold)
    guess = found.remedies[found.remedies["remedy"] == FIRST_GUESS]
    assert (guess["virtual_after_m"] <= guess["virtual_now_m"]).all()


def drive(mean: list[float], spread: float = 0.01) -> pd.DataFrame:
    table = {"vd_mean": mean, "vd_mean_sd": spread, "vd_draws": 4.0, "estimate": 0.5}
    return pd.DataFrame(table, index=range(len(mean)))


def test_an_effect_is_in_proportion_and_clear_of_its_noise() -> None:
    now = drive([0.4, 0.6])
    half = advising._effect(now, drive([0.2, 0.3]))
    assert half["after_m"] == pytest.approx(0.25)
    assert half["helps"]
    # of the difference of two means over two places of four draws each
    error = np.sqrt(2 * 2 * 0.01**2 / 4) / 2
    for less, helps in ((1.9, False), (2.1, True)):
        after = drive([0.4 - less * error, 0.6 - less * error])
        assert advising._effect(now, after)["helps"] is helps
    lost = advising._effect(now, drive([np.nan, 0.3]))
    assert lost["after_m"] == pytest.approx(0.25)  # of the place that is known
    nothing = advising._effect(now, drive([np.nan, np.nan]))
    assert (np.isnan(nothing["after_m"]), nothing["helps"]) == (True, False)
    assert not advising._effect(now, drive([0.0, 0.0], np.nan))["helps"]  # one draw says nothing


def test_what_is_tried_is_what_the_run_has_not() -> None:
    tried, left_out = remedies_of(NOW, GRID)
    assert tried["cells of 1 m"].cell_size == 1.0
    assert tried["the whole range of 100 m"].range_max is None
    assert tried["no blind sector"].blind_rear_deg == 0.0
    assert tried["HDL64"].sensor == ts.HDL64
    assert tried["HDL64"].range_max == 60.0
    assert "VLP16" not in tried
    assert not left_out
    assert len({choice.name for choice in tried.values()}) == len(tried)
    whole = replace(NOW, seeing=VirtualSettings(range_max=None, blind_rear_deg=0.0))
    tried, left_out = remedies_of(whole, TileGrid.of(21.0, 1.0))
    assert set(tried) == {"cells of 1 m", "HDL64", "OS1_128"}
    assert set(left_out) == {"the whole range of 100 m", "no blind sector"}
    _, left_out = remedies_of(replace(NOW, cell_size=1.0), TileGrid.of(21.25, 1.0))
    assert "21.25 m" in left_out["cells of 0.5 m"]
    mount = Mount(x=1.0, z=0.2)
    mounted = ts.VLP16.model_copy(update={"mount": mount})
    assert remedies_of(replace(NOW, sensor=mounted), GRID)[0]["HDL64"].sensor.mount == mount
    both = replace(NOW, sensor=Vehicle(sensors=(ts.VLP16, ts.HDL64)))
    assert "another lidar" in remedies_of(both, GRID)[1]


def test_the_command_says_the_same_in_words_and_for_machines(run: Path, capsys: Told) -> None:
    limit = low(run)
    line = ["advise", str(run), "--threshold", str(limit)]
    assert command([*line, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    found = ts.advise(run, threshold=limit)
    assert len(told["stretches"]) == len(found.stretches) > 0
    first = told["stretches"][0]
    assert first["now_m"] == found.stretches["now_m"][0]
    assert len(first["remedies"]) == found.remedies["remedy"].nunique()
    report = json.loads((run / "report" / "report.json").read_text())
    assert told["worth"] == list(found.worth) == [*report["worth"]["told"], OF_REMEDIES]
    assert command(line) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert first["verdict"] in said
    assert found.worth[0] in said
    assert FIRST_GUESS in said
    assert command(["advise", str(run), "--threshold", "50"]) == 0
    assert "nothing to mend" in capsys.readouterr().out


def test_a_run_without_virtual_drives_is_refused(run: Path, tmp_path: Path) -> None:
    (tmp_path / "tables").symlink_to(run / "tables")
    with pytest.raises(UsageError, match="virtual drives"):
        ts.advise(tmp_path)


def test_where_a_run_cannot_be_written_the_option_for_another_place_is_named(
    run: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(folder: Files) -> None:
        raise OSError(errno.EROFS, "Read-only file system", folder.root)

    monkeypatch.setattr(Files, "make", refuse)
    assert command(["advise", str(run), "--threshold", "0.001"]) == 2
    assert "--out names another place" in capsys.readouterr().err
