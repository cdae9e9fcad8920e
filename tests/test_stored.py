"""What is stored can be trusted: what is read is what was written, or the file is named."""

import errno
import json
import shutil
import subprocess
import sys
import zlib
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st
from killed import killed_after
from scenes import scene

import tilestream as ts
from tilestream.apps.verify import repair, verify
from tilestream.cli import run
from tilestream.errors import IncompleteError, LockedError, PartialError, TilestreamError
from tilestream.files import Files
from tilestream.formats.points.pcd import write_pcd
from tilestream.lock import only_writer
from tilestream.marks import Mark, sealed, unsealed
from tilestream.pipeline.jobs.inventory import inventory_of, tables_in
from tilestream.records import Column
from tilestream.store import NODE, POINTS, Tile
from tilestream.tables import read_mark, read_tables, write_table

OFFSET = (370_000.0, 3_950_000.0, 30.0)
"""Where the street is [m]."""
FLIPS = 300
"""One-bit flips of a kind of file."""


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory) -> Path:
    points = np.vstack([scene("canyon", 1), scene("canyon", 2, offset=(20.0, 0.0, 0.0))])
    path = tmp_path_factory.mktemp("cloud") / "street.pcd"
    write_pcd(path, points + OFFSET)
    return path


@pytest.fixture(scope="module")
def reference(cloud: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map in eight tiles."""
    url = tmp_path_factory.mktemp("map") / "map.zarr"
    store = ts.ingest(cloud, url, tile_size=10.0)
    assert len(store.keys()) >= 8
    return url


@pytest.fixture
def store(reference: Path, tmp_path: Path) -> ts.TileStore:
    return ts.open_store(str(shutil.copytree(reference, tmp_path / "map.zarr")))


def route() -> ts.Route:
    along = np.arange(2.0, 30.0, 4.0)
    positions = np.column_stack([along, np.zeros_like(along), np.full_like(along, 0.0)]) + OFFSET
    return ts.Route("r", positions, along - along[0], np.zeros_like(along))


# --- Which tiles there must be


def test_a_half_made_map_is_refused_by_name_until_its_ingest_has_ended(
    cloud: Path, reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = tmp_path / "map.zarr"
    call = "ts.ingest(sys.argv[2], sys.argv[1], tile_size=10.0, watch=watch)"
    killed_after(5, "merge", call, str(url), str(cloud))
    half = ts.open_store(str(url))
    assert not half.condition().whole
    assert len(half.marks()) == len(ts.open_store(str(reference)).keys()) > len(half.keys()) == 5
    assert run(["status", str(url)]) == 1
    assert "half-made" in capsys.readouterr().err
    with pytest.raises(IncompleteError, match=r"half-made.*--partial"):
        ts.factors_along(half, [route()], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    ts.ingest(cloud, url, tile_size=10.0)
    assert tree(url) == tree(reference)
    assert run(["status", str(url)]) == 0


def test_a_lost_tile_is_missed_and_made_again(
    cloud: Path, reference: Path, store: ts.TileStore
) -> None:
    key = store.keys()[3]
    shutil.rmtree(f"{store.url}/{key}")
    (lost,) = store.condition().lost.items()
    assert lost[0] == key
    assert lost[1].facts["read"] > 0
    assert str(key) in str(store.condition())
    assert run(["status", store.url]) == 1
    with pytest.raises(IncompleteError, match=str(key)):
        ts.observe_along(store, [route()], f"{store.url}-out")
    ts.ingest(cloud, store.url, tile_size=10.0)
    assert tree(Path(store.url)) == tree(reference)


def test_a_tile_that_the_map_must_not_have_is_none(store: ts.TileStore) -> None:
    """E.g. one of an older map, left by a process that was killed."""
    key = ts.TileKey(900, 900)
    shutil.copytree(f"{store.url}/{store.keys()[0]}", f"{store.url}/{key}")
    assert key not in store.keys()
    assert store.tiles_over(store.grid.core(key)) == []
    assert store.condition().whole


def test_with_partial_every_row_that_could_see_a_gap_says_so(
    store: ts.TileStore, tmp_path: Path
) -> None:
    whole = ts.factors_along(store, [route()], tmp_path / "whole")
    lost = store.grid.key_at(OFFSET[0] + 25.0, OFFSET[1] + 1.0)
    shutil.rmtree(f"{store.url}/{lost}")
    sensor = ts.VLP16.model_copy(update={"range_max": 12.0})
    whole = ts.factors_along(
        ts.open_store(store.url), [route()], tmp_path / "some", sensor=sensor, partial=True
    )
    core = store.grid.core(lost)
    for row in whole.itertuples():
        away = np.hypot(
            max(core.x_lo / 1000 - row.x, row.x - core.x_hi / 1000, 0.0),
            max(core.y_lo / 1000 - row.y, row.y - core.y_hi / 1000, 0.0),
        )
        if away < 12.0:
            assert row.status != "done"
            assert str(lost) in row.reason
        elif away > 40.0:
            assert row.status == "done"
    assert (whole["status"] != "done").any()


def test_a_tile_is_few_objects(store: ts.TileStore, tmp_path: Path) -> None:
    ts.factors_along(store, [route()], tmp_path / "a")
    ts.observe_along(store, [route()], tmp_path / "b")
    most = max(
        sum(path.is_file() for path in (Path(store.url) / str(key)).rglob("*"))
        for key in store.keys()
    )
    assert 7 <= most <= 12


def test_a_lost_table_is_missed(store: ts.TileStore, tmp_path: Path) -> None:
    ts.factors_along(store, [route()], tmp_path)
    folder = str(tmp_path / "factors")
    known = inventory_of(folder)
    assert sorted(f"{folder}/{name}" for name in known) == tables_in(folder)
    assert all(entry.sources == ("../map.zarr",) for entry in known.values())
    first = min(known)
    (tmp_path / "factors" / first).unlink()
    with pytest.raises(IncompleteError, match=first):
        tables_in(folder)


# --- One writer


WAITS = """
import sys, time
from pathlib import Path
import tilestream as ts

def watch(outcome, *_):
    if outcome.stage == "merge":
        print("merging", flush=True)
        time.sleep(600)

ts.ingest(sys.argv[2], sys.argv[1], tile_size=10.0, watch=watch)
"""


def test_of_two_clients_in_one_directory_one_works_and_the_other_takes_over_a_dead_one(
    cloud: Path, reference: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    url = str(tmp_path / "map.zarr")
    ingest = ["ingest", str(cloud), "--store", url, "--tile-size", "10"]
    command = [sys.executable, "-c", WAITS, url, str(cloud)]
    first = subprocess.Popen(command, stdout=subprocess.PIPE)
    try:
        assert first.stdout is not None
        assert first.stdout.readline() == b"merging\n"
        assert run(ingest) == 1
        assert f"being written by process {first.pid}" in capsys.readouterr().err
        assert run(["status", url]) == 1
        assert f"being written by process {first.pid}" in capsys.readouterr().err
    finally:
        first.kill()
        first.wait()
    assert run(ingest) == 0
    assert tree(Path(url)) == tree(reference)


def test_a_folder_of_tables_has_one_writer(store: ts.TileStore, tmp_path: Path) -> None:
    with only_writer(tmp_path), pytest.raises(LockedError, match=str(tmp_path)):
        ts.factors_along(store, [route()], tmp_path)
    assert (ts.factors_along(store, [route()], tmp_path)["status"] == "done").all()


# --- Checksums


def tree(folder: Path) -> dict[str, int]:
    return {
        str(path.relative_to(folder)): zlib.crc32(path.read_bytes())
        for path in folder.rglob("*")
        if path.is_file()
    }


def flipped(content: bytes, bit: int) -> bytes:
    changed = bytearray(content)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


def outcomes(path: Path, read: Callable[[], Any], same: Callable[[Any], bool]) -> Counter[str]:
    """What becomes of one-bit flips of a file: an error that names it, or the same data."""
    content = path.read_bytes()
    rng = np.random.default_rng(len(content))
    found: Counter[str] = Counter()
    for bit in rng.choice(8 * len(content), min(FLIPS, 8 * len(content)), replace=False):
        path.write_bytes(flipped(content, int(bit)))
        try:
            found["same" if same(read()) else "wrong"] += 1
        except TilestreamError as error:
            found["named" if path.parent.name in str(error) else "unnamed"] += 1
    path.write_bytes(content)
    return found


@pytest.mark.parametrize("file", ["c/0", NODE])
@pytest.mark.parametrize("table", [POINTS, "cells_2000"])
def test_a_flip_in_a_tile_is_an_error_that_names_the_file(
    store: ts.TileStore, table: str, file: str, tmp_path: Path
) -> None:
    if table != POINTS:
        ts.factors_along(store, [route()], tmp_path)
    tile = Tile(store, store.grid.key_at(OFFSET[0] + 5.0, OFFSET[1] + 1.0))
    truth = tile.read_table(table)

    def same(read: dict[str, np.ndarray]) -> bool:
        return all(np.array_equal(read[name], truth[name]) for name in truth)

    path = Path(store.url) / str(tile.key) / table / file
    found = outcomes(path, lambda: tile.read_table(table), same)
    assert set(found) <= {"named", "same"}
    assert found["named"] > 0.5 * sum(found.values())


def test_a_flip_in_the_record_or_the_manifest_is_an_error(store: ts.TileStore) -> None:
    truth = store.marks(), store.sources()

    def read() -> Any:
        ts.store.manifest.read_manifest.cache_clear()
        opened = ts.open_store(store.url)
        return opened.marks(), opened.sources()

    (manifest,) = Path(store.url).glob("manifest_*")
    for path in (Path(store.url) / NODE, manifest / NODE, manifest / "c" / "0"):
        found = outcomes(path, read, lambda one: one == truth)
        assert found["wrong"] == 0, path


def test_a_flip_in_a_parquet_table_is_an_error_that_names_it(tmp_path: Path) -> None:
    frame = pd.DataFrame({"a": np.arange(300.0), "b": ["here"] * 300})
    columns = [Column("a", "place", "m", "A.", ""), Column("b", "place", "", "B.", "")]
    path, mark = tmp_path / "table.parquet", Mark("done", identity="x", facts={"rows": 300})
    write_table(str(path), frame, columns, mark)
    pd.testing.assert_frame_equal(read_tables([str(path)]), frame)
    found = outcomes(path, lambda: read_tables([str(path)]), lambda _: False)
    assert set(found) == {"named"}
    noticed = ("damaged", "missing")
    found = outcomes(
        path, lambda: read_mark(str(path)), lambda one: one == mark or one.status in noticed
    )
    assert set(found) == {"same"}
    pd.testing.assert_frame_equal(pd.read_parquet(path), frame)  # by any other reader


@given(
    st.dictionaries(
        st.text(max_size=5), st.integers() | st.floats() | st.text(max_size=5) | st.booleans()
    )
)
def test_a_seal_survives_json(content: dict[str, Any]) -> None:
    content.pop("checksum", None)
    again = unsealed(json.loads(json.dumps(sealed(content))))
    assert json.dumps(again, sort_keys=True) == json.dumps(content, sort_keys=True)


def test_a_changed_fragment_is_noticed_by_the_merge(cloud: Path, tmp_path: Path) -> None:
    url = tmp_path / "map.zarr"
    call = "ts.ingest(sys.argv[2], sys.argv[1], tile_size=10.0, watch=watch)"
    killed_after(1, "merge", call, str(url), str(cloud))
    (fragment,) = (url / "fragments").glob("*.bin")
    fragment.write_bytes(flipped(fragment.read_bytes(), 8 * fragment.stat().st_size - 9))
    with pytest.raises(PartialError, match=r"0-0\.bin is damaged"):
        ts.ingest(cloud, url, tile_size=10.0)
    assert ts.ingest(cloud, url, tile_size=10.0).condition().whole


# --- Verify and repair


def test_verify_lists_what_is_damaged_and_repair_lets_the_same_command_make_it_again(
    cloud: Path, reference: Path, store: ts.TileStore, capsys: pytest.CaptureFixture[str]
) -> None:
    read, damages = verify(store.url)
    assert damages == []
    assert read >= len(store.keys())
    assert run(["verify", store.url]) == 0
    first, second = store.keys()[:2]
    for path, at in ((f"{first}/points/c/0", 40), (f"{second}/points/{NODE}", 300)):
        file = Path(store.url) / path
        file.write_bytes(flipped(file.read_bytes(), 8 * at))
    capsys.readouterr()
    assert run(["verify", store.url]) == 1
    told = capsys.readouterr().err
    assert f"{first}/points" in told
    assert f"{second}/points" in told
    assert [line.count(store.url) for line in told.splitlines()[1:]] == [1, 1]
    assert run(["verify", store.url, "--repair"]) == 0
    assert set(store.condition().lost) == {first, second}
    ts.ingest(cloud, store.url, tile_size=10.0)
    assert tree(Path(store.url)) == tree(reference)


@pytest.mark.parametrize("file", ["{key}/zarr.json", "{manifest}/c/0", "{manifest}/zarr.json"])
def test_what_a_map_is_found_by_is_verified_and_made_again(
    cloud: Path, reference: Path, store: ts.TileStore, file: str
) -> None:
    (manifest,) = Path(store.url).glob("manifest_*")
    path = Path(store.url) / file.format(key=store.keys()[0], manifest=manifest.name)
    path.write_bytes(flipped(path.read_bytes(), 8 * (path.stat().st_size // 2)))
    ts.store.manifest.read_manifest.cache_clear()
    removed, left = repair(store.url)
    assert len(removed) == 1
    assert left == []
    ts.ingest(cloud, store.url, tile_size=10.0)
    assert tree(Path(store.url)) == tree(reference)


def test_without_its_record_a_map_has_to_be_made_from_nothing(
    cloud: Path, reference: Path, store: ts.TileStore
) -> None:
    record = Path(store.url) / NODE
    record.write_bytes(record.read_bytes().replace(b'"crs": null', b'"crs": "no"', 1))
    _, (damage,) = verify(store.url)
    assert "remove the folder" in damage.reason
    assert repair(store.url) == ([], [damage])
    shutil.rmtree(store.url)
    ts.ingest(cloud, store.url, tile_size=10.0)
    assert tree(Path(store.url)) == tree(reference)


def test_what_cannot_be_made_again_is_not_removed(cloud: Path, tmp_path: Path) -> None:
    source, url = tmp_path / "only.pcd", tmp_path / "map.zarr"
    shutil.copy(cloud, source)
    key = ts.ingest(source, url, tile_size=10.0).keys()[0]
    source.unlink()
    chunk = url / str(key) / POINTS / "c" / "0"
    chunk.write_bytes(flipped(chunk.read_bytes(), 99))
    removed, left = repair(url)
    assert removed == []
    assert [damage.path for damage in left] == [f"{url}/{key}/{POINTS}"]
    assert chunk.exists()


def test_verify_reads_the_tables_of_a_folder(store: ts.TileStore, tmp_path: Path) -> None:
    ts.factors_along(store, [route()], tmp_path / "out")
    tables = sorted((tmp_path / "out" / "factors").glob("*.parquet"))
    tables[0].write_bytes(flipped(tables[0].read_bytes(), 999))
    tables[1].unlink()
    _, damages = verify(tmp_path / "out")
    assert sorted(damage.path for damage in damages) == [str(path) for path in tables[:2]]
    repair(tmp_path / "out")
    rows = ts.factors_along(store, [route()], tmp_path / "out")
    assert (rows["status"] == "done").all()
    assert verify(tmp_path / "out")[1] == []


@pytest.mark.parametrize(("state", "whole"), [("done", True), ("failed", True), ("stopped", False)])
def test_a_run_that_did_not_end_is_not_whole(state: str, whole: bool, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text(json.dumps(sealed({"state": state, "files": {}})))
    read, damages = verify(tmp_path)
    assert read == 1
    assert (damages == []) is whole
    assert run(["verify", str(tmp_path), "--repair"]) == (0 if whole else 1)
    assert (tmp_path / "run.json").exists()


def test_brackets_within_brackets_are_damage(store: ts.TileStore) -> None:
    key = store.keys()[0]
    for name in (f"{key}/{POINTS}/{NODE}", NODE):
        (Path(store.url) / name).write_text("[" * 100_000)
        _, damages = verify(store.url)
        assert any("nested too deep" in damage.reason for damage in damages), name


# --- Absent is not unreadable


@pytest.mark.parametrize(
    "error", [PermissionError(errno.EACCES, "denied"), OSError(errno.EMFILE, "too many open files")]
)
def test_a_mark_that_cannot_be_read_is_an_error_and_no_empty_ground(
    store: ts.TileStore, monkeypatch: pytest.MonkeyPatch, error: OSError
) -> None:
    key, other = store.keys()[:2]
    read = store.files.fs.cat_file

    def denied(path: str, *args: Any, **options: Any) -> bytes:
        if f"/{other}/" in path:
            raise error
        return bytes(read(path, *args, **options))

    monkeypatch.setattr(store.files.fs, "cat_file", denied)
    assert len(store.tile(key).points())
    with pytest.raises(OSError, match=error.strerror):
        store.points_in(store.grid.halo_box(key))
    with pytest.raises(OSError, match=error.strerror):
        store.marks()


@pytest.mark.parametrize(("code", "kind"), [("403", PermissionError), ("503", OSError)])
def test_a_server_that_refuses_is_no_empty_ground(
    store: ts.TileStore, s3_bucket: str, monkeypatch: pytest.MonkeyPatch, code: str, kind: type
) -> None:
    client_error = pytest.importorskip("botocore.exceptions").ClientError
    far = ts.ingest(store.sources()[0]["path"], f"{s3_bucket}/map.zarr", tile_size=10.0)
    key, other = far.keys()[:2]
    call = type(far.files.fs)._call_s3

    async def refused(self: Any, method: str, *args: Any, **options: Any) -> Any:
        if method == "get_object" and f"/{other}/" in options.get("Key", ""):
            raise client_error({"Error": {"Code": code, "Message": "no"}}, method)
        return await call(self, method, *args, **options)

    monkeypatch.setattr(type(far.files.fs), "_call_s3", refused)
    far.files.fs.retries = 1
    assert len(far.tile(key).points())
    with pytest.raises((kind, client_error)):
        far.points_in(far.grid.halo_box(key))


# --- A user's path is never a pattern


@pytest.mark.parametrize("name", ["run[12]", "run?", "run*", "~run", "a::b", "run#1"])
def test_no_character_of_a_path_has_a_meaning(
    cloud: Path, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    store = ts.ingest(cloud, "plain.zarr", tile_size=10.0)
    before = ts.factors_along(store, [route()], "run1")
    kept = tree(tmp_path / "run1")
    odd = ts.ingest(cloud, f"{name}.zarr", tile_size=10.0)
    assert odd.marks() == store.marks()
    rows = ts.factors_along(odd, [route()], name)
    pd.testing.assert_frame_equal(rows, before)
    elsewhere = ts.Route("s", route().positions[:2], route().arc_length[:2], route().heading[:2])
    ts.factors_along(odd, [elsewhere], name)  # whose tables replace the others
    assert tree(tmp_path / "run1") == kept
    assert verify(name)[1] == verify(f"{name}.zarr")[1] == []
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["plain.zarr", "run1", name, f"{name}.zarr"]
    )


def test_only_what_an_inventory_names_is_removed(store: ts.TileStore, tmp_path: Path) -> None:
    ts.factors_along(store, [route()], tmp_path)
    mine = tmp_path / "factors" / "mine.parquet"
    pd.DataFrame({"a": [1]}).to_parquet(mine)
    elsewhere = ts.Route("s", route().positions[:2], route().arc_length[:2], route().heading[:2])
    ts.factors_along(store, [elsewhere], tmp_path)
    assert mine.exists()
    named = inventory_of(str(tmp_path / "factors"))
    assert {p.name for p in (tmp_path / "factors").glob("*.parquet")} == {*named, "mine.parquet"}


# --- Files


def test_a_file_is_whole_or_as_it_was(tmp_path: Path) -> None:
    file = Files.at(tmp_path / "new" / "file")
    file.write(b"one")

    def broken() -> None:
        with file.writing() as stream:
            stream.write(b"two")
            raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        broken()
    assert file.read() == b"one"
    assert file.parent.names() == ["file"]


@pytest.mark.parametrize("place", ["local", "memory"])
def test_files_are_listed_and_removed_by_name(place: str, tmp_path: Path) -> None:
    folder = Files.at(f"memory://stored-{tmp_path.name}" if place == "memory" else tmp_path / "f")
    for name in ("a/1", "a/2", "b[1]", "b1"):
        folder.under(name).write(name.encode())
    assert folder.names() == ["a", "b1", "b[1]"]
    assert folder.read_all(["a/1", "c", "b[1]"]) == [b"a/1", None, b"b[1]"]
    folder.under("b[1]").remove()
    folder.under("nothing").remove()
    assert folder.names() == ["a", "b1"]
    folder.under("a").remove()
    assert folder.names() == ["b1"]
