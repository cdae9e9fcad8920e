"""Every reader that is fuzzed, a line each: how a small file is made, and how it is read whole."""

import functools
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import bags
import fuzz_bombs as bombs
import logs
import numpy as np
import pandas as pd
from fuzz_mutations import Mutate, in_chunks, in_json, in_pages, in_zip, mutated
from mcap.writer import CompressionType
from model_data import dataset, drives
from points import far_points, write_e57, write_map_directory, write_ply, write_ply_lists
from test_lanelet2 import osm
from test_las import laz_of_chunks
from test_routes import as_csv, as_kitti, as_tum, geojson, line

import tilestream as ts
from tilestream.files import Files
from tilestream.formats import open_source
from tilestream.formats.logs import open_log
from tilestream.formats.points.las import write_las
from tilestream.formats.points.pcd import write_pcd
from tilestream.formats.projector import METADATA, PROJECTOR
from tilestream.formats.routes import read_routes
from tilestream.marks import Mark
from tilestream.matcher import RegistrationSettings
from tilestream.model.file import load_model, save_model
from tilestream.model.forest import Growth, PaperForest
from tilestream.model.prediction import predict
from tilestream.model.training import train
from tilestream.pipeline.jobs.inventory import Entry, inventory_of, write_inventory
from tilestream.pipeline.jobs.run_names import INVENTORY
from tilestream.pipeline.jobs.run_settings import read_settings
from tilestream.records import Column
from tilestream.sensor import sensor_of
from tilestream.simulation.settings import load_preset
from tilestream.store.manifest import read_manifest
from tilestream.tables import read_mark, read_tables, write_table

PLACES = drives(2, {"d": 20})[0]
JOB = """out: run
map: {sources: [a.pcd], tile_size: 50.0}
drives:
  - {log: a.mcap, name: monday, every: 2}
routes: [r.csv]
sensor: {name: VLP16, range_max: 60.0}
label: {matcher: {solver: raw}, starts: {radius: 1.0}}
observe: {range_max: 40.0}
memory: 2GB
"""
MATCHER = """/**:
  ros__parameters:
    frame: {base_frame: base_link}
    sensor_points: {required_distance: 10.0}
    ndt: {trans_epsilon: 0.02, step_size: 0.2, resolution: 3.0, max_iterations: 20}
"""
SENSOR = "- {name: VLP16, range_max: 50.0, mount: {x: 1.0, yaw_deg: 90}}\n- {name: HDL64}\n"
PRESET = "preset: mine\nlidar:\n  range_max: 75.0\nsurvey:\n  noise: 0.03\n  traffic: 1.0\n"
MAP = (
    "projector_type: TransverseMercator\nscale_factor: 0.9996\n"
    "map_origin: {latitude: 35.6, longitude: 139.7}\n"
)


@dataclass(frozen=True)
class Reader:
    """Something that reads a kind of file."""

    name: str
    """What the table calls it."""
    file: str
    """The file that is damaged, in a folder of its own."""
    make: Callable[[Path], object]
    """Writes a small one, whole."""
    read: Callable[[Path], Iterator[object]]
    """Everything that is in one, as something that has the same `repr` or bytes if it is equal."""
    mutate: Mutate = mutated
    """How it is damaged."""
    bombs: Callable[[bytes], Iterator[bytes]] = lambda _: iter(())
    """Files that are worse than any chance."""
    sealed: bool = False
    """Whether it has checksums, so that no damaged one may be read as other data."""

    def digest(self, path: Path) -> str:
        """What is in a file, in a few letters."""
        found = hashlib.sha256()
        for part in self.read(path):
            found.update(part.tobytes() if isinstance(part, np.ndarray) else repr(part).encode())
        return found.hexdigest()[:16]


def points(path: Path) -> Iterator[object]:
    """A source of points, whose promises are kept."""
    source = open_source(path)
    info, count = source.info(), 0
    yield info.crs, info.fields
    for span in source.spans(150):
        for block in source.blocks(span, 64):
            assert np.isfinite(block.points).all(), "points that are not finite"
            seen = len(block.points) + block.dropped + block.left_out
            assert seen <= 64, "a block that is too long"
            count += seen
            yield block.points
    assert count == info.points, f"{count} of {info.points} points"


def log(path: Path) -> Iterator[object]:
    """A log as scans, and as points of a map."""
    opened = open_log(path)
    yield opened.info().fields, opened.frame
    for scan in opened.scans():
        assert np.isfinite(scan.points).all(), "points that are not finite"
        yield scan.stamp_ns
        yield from (scan.points, scan.T_map_lidar, scan.intensity, scan.time_offset)
    source = open_source(path)
    for span in source.spans(150):
        for block in source.blocks(span, 64):
            assert np.isfinite(block.points).all(), "points that are not finite"


def routes(path: Path) -> Iterator[object]:
    for route in read_routes(path):
        yield route.route_id, route.crs
        yield route.positions
        yield route.heading


def map_directory(path: Path) -> Iterator[object]:
    return points(path.parent)


def job(path: Path) -> Iterator[object]:
    yield read_settings(path).model_dump_json()


def matcher(path: Path) -> Iterator[object]:
    found = RegistrationSettings.of_files(str(path))
    yield found.model_dump(), found.resolution
    yield [note.replace(str(path), "") for note in found.notes]


def sensor(path: Path) -> Iterator[object]:
    yield sensor_of(str(path))


def preset(path: Path) -> Iterator[object]:
    yield load_preset(str(path))


def model(path: Path) -> Iterator[object]:
    """A model, and what it estimates."""
    found = load_model(path)
    yield json.dumps(found.facts, sort_keys=True), found.worst
    yield predict(found, PLACES).to_dict("list")


def write_model(path: Path) -> None:
    with patch.object(PaperForest, "defaults", asdict(Growth(trees=3))):
        save_model(train(dataset(1, 0.9, {"a": 120, "b": 120}), recipe="paper"), path)


def in_store(name: str, inside: str) -> Reader:
    """A file inside a store of one tile, which is read with all that it says of itself."""

    def at(path: Path) -> Path:
        found, *_ = sorted((path.parent / "map.zarr").glob(inside))
        return found

    def make(path: Path) -> None:
        shutil.rmtree(path.parent / "map.zarr", ignore_errors=True)
        write_pcd(path.with_name("map.pcd"), far_points(200))
        ts.ingest(path.with_name("map.pcd"), path.parent / "map.zarr", tile_size=1000.0)
        shutil.copy(at(path), path)

    def read(path: Path) -> Iterator[object]:
        shutil.copy(path, at(path))
        read_manifest.cache_clear()
        store = ts.open_store(str(path.parent / "map.zarr"))
        yield [source["points"] for source in store.sources()]  # not their paths: another folder's
        yield store.made_by(), store.settings, store.state()
        store.condition().require_whole()
        for key in store.keys():
            yield key, store.tile(key).points_mm()

    return Reader(name, "stored", make, read, sealed=True)


def write_parquet(path: Path) -> None:
    frame = pd.DataFrame({"a": np.arange(300.0), "b": ["here"] * 300})
    columns = [Column("a", "place", "m", "A.", ""), Column("b", "place", "", "B.", "")]
    write_table(str(path), frame, columns, Mark("done", identity="x", facts={"rows": 300}))


def parquet(path: Path) -> Iterator[object]:
    yield read_tables([str(path)]).to_dict("list")
    yield read_mark(str(path))


def write_list(path: Path) -> None:
    entries = {"a.parquet": Entry("factors", "x", ("map.zarr",), (1, 2))}
    write_inventory(Files.at(path.parent), entries)


def inventory(path: Path) -> Iterator[object]:
    yield inventory_of(str(path.parent))


def text(content: str) -> Callable[[Path], object]:
    return lambda path: path.write_text(content)


def write_map(path: Path) -> None:
    write_map_directory(path.parent, far_points(60))
    (path.parent / PROJECTOR).write_text(MAP)


def street(**options: Any) -> Callable[[Path], object]:
    """A log of four scans, written with these options of `mcap`."""

    def make(path: Path) -> None:
        whole = logs.street_log(path.with_name("whole.mcap"), scans=4, chunk_size=1500)
        logs.rewrite(whole, path, **{"chunk_size": 1500, **options})
        whole.unlink()

    return make


def in_other(write: Callable[[Path, list[bags.Raw]], Path]) -> Callable[[Path], object]:
    """The same log, in another container of ROS."""

    def make(path: Path) -> None:
        whole = logs.street_log(path.with_name("whole.mcap"), scans=4)
        messages = bags.messages_of(whole)
        whole.unlink()
        write(path, messages)

    return make


def ros1_mcap(path: Path, messages: list[bags.Raw]) -> Path:
    return bags.write_mcap(path, bags.as_ros1(messages), "ros1")


def bz2_bag(path: Path, messages: list[bags.Raw]) -> Path:
    return bags.write_bag(path, messages, "BZ2")


def write_folder(path: Path) -> None:
    in_other(lambda place, messages: bags.fill(place.parent, messages, 2))(path)


def folder(path: Path) -> Iterator[object]:
    return log(path.parent)


def of_points(name: str, file: str, write: Callable[..., object], **more: Any) -> Reader:
    return Reader(name, file, lambda path: write(path, far_points(200)), points, **more)


def of_routes(name: str, file: str, make: Callable[[Path], object], **more: Any) -> Reader:
    return Reader(name, file, make, routes, **more)


ascii_ = functools.partial(write_pcd, encoding="ascii")
compressed = functools.partial(write_pcd, encoding="binary_compressed")
ply_text = functools.partial(write_ply, text=True)
ply_big = functools.partial(write_ply, byte_order=">")
las = functools.partial(write_las, crs="EPSG:6677")
LANES = {1: ([0, 1], [100, 101]), 2: ([1, 2], [101, 102])}
NO_CRC = {"enable_crcs": False, "enable_data_crcs": False}

READERS = (
    of_points("PCD ascii", "a.pcd", ascii_, bombs=bombs.of_pcd),
    of_points("PCD binary", "a.pcd", write_pcd, bombs=bombs.of_pcd),
    of_points("PCD compressed", "a.pcd", compressed, bombs=bombs.of_pcd),
    of_points("LAS", "a.las", las),
    of_points("LAZ", "a.laz", las, bombs=bombs.of_laz),
    Reader(
        "LAZ as COPC",
        "a.laz",
        lambda path: path.write_bytes(laz_of_chunks([10, 100, 101, 200])[0]),
        points,
        bombs=bombs.of_laz,
    ),
    of_points("PLY ascii", "a.ply", ply_text),
    of_points("PLY binary", "a.ply", write_ply),
    of_points("PLY big-endian", "a.ply", ply_big),
    of_points("PLY with lists", "a.ply", write_ply_lists),
    of_points("E57", "a.e57", write_e57, mutate=in_pages, bombs=bombs.of_e57),
    Reader("Autoware metadata", METADATA, write_map, map_directory, bombs=bombs.of_yaml),
    Reader("Autoware projector", PROJECTOR, write_map, map_directory, bombs=bombs.of_yaml),
    Reader("MCAP zstd", "a.mcap", street(), log, in_chunks, bombs.of_mcap),
    Reader(
        "MCAP lz4", "a.mcap", street(compression=CompressionType.LZ4), log, in_chunks, bombs.of_mcap
    ),
    Reader("MCAP plain", "a.mcap", street(compression=CompressionType.NONE, **NO_CRC), log),
    Reader("MCAP no chunks", "a.mcap", street(use_chunking=False, **NO_CRC), log),
    Reader("MCAP of ROS 1", "a.mcap", in_other(ros1_mcap), log, in_chunks),
    Reader("rosbag2 metadata", "metadata.yaml", write_folder, folder, bombs=bombs.of_yaml),
    Reader("rosbag2 sqlite3", "a.db3", in_other(bags.write_db3), log),
    Reader("ROS 1 bag", "a.bag", in_other(bags.write_bag), log),
    Reader("ROS 1 bag, bz2", "a.bag", in_other(bz2_bag), log, bombs=bombs.of_bag),
    of_routes("GeoJSON", "a.geojson", lambda p: geojson(p, line([[0, 0], [9, 1], [20, 0]])),
              mutate=in_json, bombs=bombs.of_json),
    of_routes("CSV", "a.csv", as_csv, bombs=bombs.of_rows),
    of_routes("TUM", "a.tum", as_tum, bombs=bombs.of_rows),
    of_routes("KITTI", "a.kitti", as_kitti, bombs=bombs.of_rows),
    of_routes("Lanelet2", "a.osm", lambda path: osm(path, LANES), bombs=bombs.of_osm),
    Reader("job", "job.yaml", text(JOB), job, bombs=bombs.of_yaml),
    Reader("sensor", "sensor.yaml", text(SENSOR), sensor, bombs=bombs.of_yaml),
    Reader("matcher", "ndt.param.yaml", text(MATCHER), matcher, bombs=bombs.of_yaml),
    Reader("preset", "preset.yaml", text(PRESET), preset, bombs=bombs.of_yaml),
    Reader("model", "a.skops", write_model, model, in_zip, bombs.of_model),
    in_store("tile values", "*_*/points/c/0"),
    in_store("tile mark", "*_*/points/zarr.json"),
    in_store("store record", "zarr.json"),
    in_store("manifest values", "manifest_*/c/0"),
    in_store("manifest mark", "manifest_*/zarr.json"),
    Reader("Parquet table", "a.parquet", write_parquet, parquet, sealed=True),
    Reader("inventory", INVENTORY, write_list, inventory, in_json, bombs.of_json, sealed=True),
)  # fmt: skip
