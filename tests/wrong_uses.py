"""A small world in which a command can be used wrongly: a map, routes, a drive, a run, and what is
none of these.
"""

import shutil
from pathlib import Path

import logs
import numpy as np
import zarr
from logs import START, pose
from scenes import PLACES, in_map

import tilestream as ts
from tilestream.formats.points.pcd import write_pcd

JOB = "out: made\nmap: {sources: [street.pcd]}\nroutes: [route.csv]\nmodel: {recipe: physics}\n"
SENSOR = "{name: mine, range_max: 20, elevations_deg: [-5, 0, 5], azimuth_step_deg: 2.0"
FILES = {
    "route.csv": "x,y\n4,0\n16,0\n",
    "far.csv": "x,y\n90000,0\n90012,0\n",
    "degrees.csv": "lat,lon\n35.6,139.7\n35.6001,139.7\n",
    "degrees.tum": "0 139.7000 35.60 0 0 0 0 1\n1 139.7001 35.60 0 0 0 0 1\n",
    "words.csv": "here,there\n1,2\n",
    "short.csv": "x,y\n4,0\n4.2,0\n",
    "job.yaml": JOB,
    "list.yaml": "- a\n- b\n",
    "tabs.yaml": "out: made\nmap:\n\tsources: [street.pcd]\n",
    "twice.yaml": f"{JOB}out: other\n",
    "misspelt.yaml": f"{JOB}spaceing: 2.0\n",
    "unit.yaml": f"{JOB}spacing: 2 m\n",
    "no_drives.yaml": "out: made\nmap: {sources: [street.pcd]}\nroutes: [route.csv]\n",
    "no_map.yaml": "out: made\nmap: {sources: [gone.pcd]}\ndrives: [{log: drive.mcap}]\n",
    "no_log.yaml": "out: made\nmap: {sources: [street.pcd]}\ndrives: [{log: gone.mcap}]\n",
    "sensor.yaml": f"{SENSOR}, range_mx: 3}}\n",
    "matcher.yaml": "{resolution: 2.0, stepsize: 0.1}\n",
    "text.pcd": "no points here\n",
    "picture.png": "no picture\n",
    "ca.pem": "no certificate\n",
    "factor.py": "COLUMNS = ()\n",
}
"""By name, what is in a file of text."""


def write_world(folder: Path) -> None:
    """All files; `map.zarr`, `other.zarr` (of another version), `run` (an estimate), `damaged` (the
    same without a record), `empty`."""
    for name, text in FILES.items():
        (folder / name).write_text(text)
    street = in_map(PLACES["canyon"](np.random.default_rng(1), 20.0, 0.3))
    write_pcd(folder / "street.pcd", street)
    (folder / "empty").mkdir()
    (folder / "full").mkdir()
    (folder / "full" / "letters.txt").write_text("mine\n")
    _write_drive(folder / "drive.mcap", street)
    ts.ingest(folder / "street.pcd", folder / "map.zarr", tile_size=20.0)
    shutil.copytree(folder / "map.zarr", folder / "other.zarr")
    group = zarr.open_group(folder / "other.zarr", mode="r+")
    ours = dict(group.attrs["tilestream"])
    group.attrs["tilestream"] = ours | {"schema": ours["schema"] + 1}
    how = {"model": "physics", "spacing": 6.0}
    ts.estimate(folder / "map.zarr", folder / "route.csv", out=folder / "run", **how)
    shutil.copytree(folder / "run", folder / "damaged")
    (folder / "damaged" / "run.json").write_text("")


def _write_drive(path: Path, street: np.ndarray) -> None:
    messages: list[logs.Message] = []
    for i in range(3):
        stamp, T = START + i * logs.SECOND, pose(x=6.0 + 3.0 * i, z=2.0)
        seen = (street - T[:3, 3])[i::5]
        messages.append(logs.odometry_at(stamp, T))
        messages.append(logs.cloud_at(stamp, seen[np.linalg.norm(seen, axis=1) < 15.0]))
    logs.write(path, messages, chunk_size=20_000)
