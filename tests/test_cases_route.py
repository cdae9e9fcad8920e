"""Files of routes that went wrong for others, each with its right value."""

from pathlib import Path

import numpy as np
import pytest

from tilestream.formats.routes import read_route


@pytest.mark.parametrize("name", ["trailing_blank_line.csv", "semicolon.csv", "z_empty.csv"])
def test_csv_is_read_as_people_write_it(name: str, cases: Path) -> None:
    route = read_route(cases / "route" / name)
    np.testing.assert_array_equal(route.positions[:, :2], [[x, 0.0] for x in range(5, 36)])
    z = np.nan if name == "z_empty.csv" else 0.0
    np.testing.assert_array_equal(route.positions[:, 2], z)
