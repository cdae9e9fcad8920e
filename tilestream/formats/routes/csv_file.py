"""Routes as CSV, as people and spreadsheets write it."""

import csv
import re
from pathlib import Path

import numpy as np

from tilestream.errors import CorruptSourceError
from tilestream.formats.routes.base import DEGREES, Path3, number, text_of

X_COLUMNS = ("x", "x_m", "east", "east_m", "easting", "local_x", "lon", "longitude")
Y_COLUMNS = ("y", "y_m", "north", "north_m", "northing", "local_y", "lat", "latitude")
Z_COLUMNS = ("z", "z_m", "up", "up_m", "height", "height_m", "ele", "elevation", "alt", "altitude")
MAYBE_GROUPED = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}")
"""A word with a comma that may part thousands or decimals."""


def read_csv(path: str) -> list[Path3]:
    """Points of one path; the first row names the columns.

    Fields are parted by what parts the first row: semicolons, tabs or commas. Where it is not
    commas, numbers may have a decimal comma. An empty z is no height. Empty rows at the end are
    passed over.

    Raises:
        CorruptSourceError: no header, no columns for x and y, an empty row between others, a field
            that is no number, or commas that may part decimals as well as thousands.
    """
    lines = text_of(path).splitlines()
    parting = next((sign for sign in ";\t" if lines and sign in lines[0]), ",")
    rows = [
        [word.strip() for word in row]
        for row in csv.reader(lines, delimiter=parting, skipinitialspace=True)
    ]
    while rows and not any(rows[-1]):
        rows.pop()
    if not rows:
        raise CorruptSourceError(f"{path}: is empty; it needs a header that names x and y")
    header = [re.split(r"[\s(\[]", name.lower())[0] for name in rows[0]]
    x, y, z = (_column(header, names) for names in (X_COLUMNS, Y_COLUMNS, Z_COLUMNS))
    if x is None or y is None:
        raise CorruptSourceError(
            f"{path}: its first row names no columns x and y (or east, north; lon, lat) but "
            f"{', '.join(rows[0])}"
        )
    columns = [column for column in (x, y, z) if column is not None]
    words = [[row[column] if column < len(row) else "" for column in columns] for row in rows[1:]]
    if parting != ",":
        words = _with_points(path, words)
    points = np.full((len(words), 3), np.nan)
    for index, row in enumerate(words):
        if not any(rows[index + 1]):
            raise CorruptSourceError(f"{path}: line {index + 2} is empty")
        for axis, (column, word) in enumerate(zip(columns, row, strict=True)):
            if axis < 2 or word.lower() not in ("", "nan"):
                place = f"line {index + 2}, column {rows[0][column]}"
                points[index, axis] = number(path, place, word)
    crs = DEGREES if header[x] in ("lon", "longitude") else None
    return [Path3(Path(path).stem, points, crs)]


def _with_points(path: str, words: list[list[str]]) -> list[list[str]]:
    """The words of numbers with decimal points where they had decimal commas.

    A comma is a decimal one where no number of the file has a point, and one at least has a comma
    that cannot part thousands.
    """
    commas = [word for row in words for word in row if "," in word]
    if not commas:
        return words
    if any("." in word for row in words for word in row) or all(
        map(MAYBE_GROUPED.fullmatch, commas)
    ):
        raise CorruptSourceError(
            f"{path}: {commas[0]!r} may have a decimal comma, or one that parts thousands; write "
            "numbers with decimal points"
        )
    return [[word.replace(",", ".") for word in row] for row in words]


def _column(header: list[str], names: tuple[str, ...]) -> int | None:
    return next((header.index(name) for name in names if name in header), None)
