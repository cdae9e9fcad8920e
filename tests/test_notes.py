"""What a reader noticed reaches people, in every command; what was not measured has not passed."""

import html
import json
from pathlib import Path
from typing import Any

import logs
import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from logs import SECOND, START, pose

import tilestream as ts
from tilestream.cli import run
from tilestream.formats.logs import ScanSelection, open_log
from tilestream.formats.points.pcd import write_pcd
from tilestream.notes import noticed, shared
from tilestream.pipeline.jobs.drive_measured import drive_measured
from tilestream.pipeline.jobs.run_settings import RunSettings
from tilestream.pipeline.jobs.sample_scans import choose_samples
from tilestream.report import gate
from tilestream.report.drives import DriveMeasured

Told = pytest.CaptureFixture[str]
GAP = "28 of 31 scans skipped: where poses are more than 1 s apart"
"""What is noticed of the log of keyframe poses."""
WHY = {"where poses are too far apart in time": 28}


@pytest.fixture(scope="module")
def street(cases: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """The map that the log lies in, of two sources; one of them has a stray and a NaN."""
    folder = tmp_path_factory.mktemp("street")
    write_pcd(folder / "b.pcd", np.array([[10.0, 0.0, 0.0], [11.0, 0.0, 0.0], [9e4, 9e4, 0.0]]))
    text = (cases / "map" / "nan_ind.pcd").read_bytes()
    (folder / "nan.pcd").write_bytes(text)
    url = str(folder / "map.zarr")
    sources = [cases / "street.pcd", folder / "b.pcd", folder / "nan.pcd"]
    ts.ingest(sources, url, tile_size=50.0)
    return url


@pytest.fixture(scope="module")
def keyframes(cases: Path) -> str:
    return str(cases / "log" / "keyframe_poses.mcap")


def asked(command: list[str], capsys: Told, code: int = 0) -> tuple[dict[str, Any], str]:
    """What a command says as JSON, and what it says besides."""
    assert run([*command, "--json"]) == code
    told = capsys.readouterr()
    return json.loads(told.out), told.err


# --- One note of many sources


def test_a_note_that_sources_share_is_told_once() -> None:
    notes = {"a": ["no CRS", "3 lost"], "b": ["no CRS"], "c": ["no CRS", "40 lost"], "d": ["x"]}
    assert [str(note) for note in shared(notes)] == [
        "a, b and 1 more: no CRS",
        "a: 3 lost",
        "c: 40 lost",
        "d: x",
    ]
    many = {f"{n}.las": [f"{n} points lost"] for n in range(1, 6)}
    (one,) = shared(many)
    (alone,) = shared({"a": [f"{n} lost" for n in range(9)]})
    assert str(alone) == "a: 0 lost (and 8 with other numbers)"
    assert str(one) == "1.las, 2.las and 3 more: 1 points lost (and 4 with other numbers)"


@given(
    st.dictionaries(
        st.text("ab", min_size=1, max_size=2), st.lists(st.sampled_from(["p 1", "p 2", "p 3", "q"]))
    )
)
def test_no_source_with_a_note_is_lost(notes: dict[str, list[str]]) -> None:
    known = noticed(notes, notes)
    assert {s: set(t) for s, t in known.items()} == {s: set(t) for s, t in notes.items() if t}
    assert all(len(set(texts)) == len(texts) for texts in known.values())
    told = shared(known)
    for source, texts in known.items():
        mine = [note for note in told if source in note.sources]
        assert {n.text for n in mine if not n.others} <= set(texts)
        assert any(n.others for n in mine) or {n.text for n in mine} == set(texts)


# --- How much of a drive was measured


@given(
    stamps=st.lists(st.integers(0, 60), min_size=1, max_size=20, unique=True),
    every=st.integers(1, 3),
    spacing=st.sampled_from([0.5, 1.0, 4.0]),
    bad=st.integers(0, 5),
)
def test_every_scan_is_measured_or_has_a_reason(
    stamps: list[int], every: int, spacing: float, bad: int, tmp_path_factory: Any
) -> None:
    """Scans at any tenths of a second; poses from 1 to 2 and from 4 to 5 s, at 3 m/s."""
    poses = [*range(10, 21), *range(40, 51)]
    messages = [logs.odometry_at(START + t * SECOND // 10, pose(x=0.3 * t)) for t in poses]
    messages += [logs.cloud_at(START + t * SECOND // 10) for t in sorted({*stamps, 15})]
    log = open_log(logs.write(tmp_path_factory.mktemp("log") / "a.mcap", messages))
    scans = ScanSelection(every=every)
    selected = scans.indices(log.stamps_ns)
    if not log.posed[selected].any():
        return
    places = len(choose_samples(log, scans, spacing))
    bad = min(bad, places)
    status = ["failed"] * bad + ["done"] * (places - bad)
    labels = pd.DataFrame({"status": status, "reason": ["no cells"] * bad + [""] * (places - bad)})
    found = drive_measured("a", log, scans, spacing, labels)
    assert found.scans == len(log) == found.measured + sum(found.reasons.values())
    assert found.measured == places - bad
    assert found.reasons.get("not selected", 0) == len(log) - len(selected)
    assert found.reasons.get("failed: no cells", 0) == bad
    unposed = {"before the first pose", "after the last pose", *WHY} & set(found.reasons)
    assert sum(found.reasons[why] for why in unposed) == found.selected - found.posed
    half = 2 * found.posed >= found.selected and 2 * found.measured >= places
    assert found.evaluated == (half and found.measured > 0)


@pytest.mark.parametrize(
    ("posed", "places", "measured", "opens"),
    [(50, 25, 25, True), (49, 25, 25, False), (80, 80, 39, False), (80, 80, 40, True)],
)
def test_a_gate_closes_where_most_of_a_drive_was_not_evaluated(
    posed: int, places: int, measured: int, opens: bool
) -> None:
    drive = DriveMeasured("d", 200, 100, posed, places, measured, {"not selected": 100})
    two = {"route_id": "a", "arc_length": [0.0, 1.0], "estimate": 0.1, "status": "done"}
    table = pd.DataFrame(two)
    why = f"less than 50% was measured of drive d ({measured} of 200 scans)"
    assert gate(table, 0.25, [drive.plain()]) == ([] if opens else [why])


def test_a_gate_closes_where_most_of_a_route_was_not_evaluated() -> None:
    """Also where that is less than 5 % of all places."""
    estimate = [0.1] * 1000 + [0.1] * 4 + [np.nan] * 6
    status = np.where(np.isnan(estimate), "missing", "done")
    routes = ["a"] * 1000 + ["b"] * 10
    places = pd.DataFrame({"route_id": routes, "estimate": estimate, "status": status})
    places["arc_length"] = np.arange(1010.0)
    assert gate(places, 0.25) == ["less than 50% of the places have an estimate on b (40%)"]
    places.loc[1004, "estimate"] = 0.1
    assert gate(places, 0.25) == []


# --- In every command


def test_ingest_tells_what_it_left_out(cases: Path, tmp_path: Path, capsys: Told) -> None:
    source = cases / "map" / "utm_with_zero_point.pcd"
    command = ["ingest", str(source), "--store", str(tmp_path / "map.zarr")]
    told, _ = asked(command, capsys)
    assert told["whole"]
    assert set(told["sources"][0]) >= {"path", "format", "points", "contents", "notes", "reason"}
    assert "scans" not in told["sources"][0]
    (note,) = told["notes"][str(source)]
    assert "1 of 7,716 points" in note
    assert run(command) == 0
    assert f"note: {source}: {note}" in capsys.readouterr().out
    assert run(["status", str(tmp_path / "map.zarr")]) == 0
    assert note in capsys.readouterr().err


def test_localize_says_that_most_was_not_measured(
    street: str, keyframes: str, tmp_path: Path, capsys: Told
) -> None:
    command = ["localize", street, keyframes, "--out", str(tmp_path / "out"), "--radius", "0.2"]
    told, err = asked(command, capsys, code=1)
    assert told["notes"][keyframes] == [GAP]
    assert told["drive"] == {
        "drive": keyframes, "scans": 31, "selected": 31, "posed": 3, "sample_points": 3,
        "measured": 3, "reasons": WHY, "evaluated": False,
    }  # fmt: skip
    assert told["sample_points"] == 3
    assert f"note: {keyframes}: {GAP}" in err
    assert "measured 3 of 31 scans" in err
    assert run(command) == 1
    shown = capsys.readouterr()
    assert "3 of 31" in shown.out
    assert GAP in shown.err
    assert run([*command, "--every", "15"]) == 0  # the three that have a pose, as is asked for
    assert run([*command, "--dry-run"]) == 0
    assert GAP in capsys.readouterr().err


def test_the_notes_of_a_map_are_told_by_who_reads_it(
    street: str, keyframes: str, tmp_path: Path, capsys: Told
) -> None:
    """A stray and points that are not finite; of the log as a route its poses."""
    out = ["--route", keyframes, "--spacing", "12"]
    commands = {
        "factors": ["factors", street, *out, "--out", str(tmp_path / "f")],
        "compare": ["compare", street, *out, "--out", str(tmp_path / "c")],
        "diff": ["diff", street, street],
        "status": ["status", street],
    }
    for name, command in commands.items():
        told, _ = asked(command, capsys)
        texts = " ".join(note for notes in told["notes"].values() for note in notes)
        assert "10 km from all others" in texts, name
        assert "points are not finite and left out" in texts, name
        if "--route" in command:
            assert told["notes"][keyframes] == [GAP]
    page = html.unescape((tmp_path / "c" / "compare.html").read_text())
    stored = json.loads((tmp_path / "c" / "compare.json").read_text())
    assert GAP in page
    assert stored["notes"][keyframes] == [GAP]


@pytest.fixture(scope="module")
def job(cases: Path, keyframes: str, tmp_path_factory: pytest.TempPathFactory) -> RunSettings:
    """A job whose one drive has three scans with a pose, and a stray in its map."""
    folder = tmp_path_factory.mktemp("job")
    values: dict[str, Any] = {
        "out": str(folder / "run"),
        "map": {"sources": [str(cases / "street.pcd")], "tile_size": 50.0},
        "drives": [{"log": keyframes}],
        "label": {"starts": {"radius": 0.2}},
        "model": {"recipe": "physics"},
        "spacing": 4.0,
    }
    settings = RunSettings(**values)
    (folder / "job.yaml").write_text(json.dumps(settings.model_dump(mode="json")))
    return settings


def test_a_job_says_what_it_could_not_measure(job: RunSettings, capsys: Told) -> None:
    config = str(Path(job.out).parent / "job.yaml")
    log = job.drives[0].log
    told, _ = asked(["plan", config], capsys)
    assert told["notes"][log] == [GAP]
    report, err = asked(["run", config, "--workers", "1", "--fail-over", "9"], capsys, code=1)
    assert "less than 50% was measured of drive keyframe_poses (3 of 31 scans)" in err
    assert report["notes"][log] == [GAP]
    (drive,) = report["drives"]
    assert (drive["measured"], drive["scans"], drive["reasons"]) == (3, 31, WHY)
    record = json.loads((Path(job.out) / "run.json").read_text())
    assert record["notes"][log] == [GAP]
    assert record["drives"] == report["drives"]
    page = html.unescape((Path(job.out) / "report" / "index.html").read_text())
    assert GAP in page
    assert "less than 50 % measured" in page.replace("\xa0", " ")
    assert run(["run", config, "--workers", "1"]) == 0
    shown = capsys.readouterr()
    assert "keyframe_poses: measured 3 of 31 scans" in shown.out
    assert GAP in shown.err
    assert f"{report['headline']['estimated']} of {report['headline']['places']}" in shown.out
