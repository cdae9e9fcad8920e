"""Routes from any file that draws a path: the formats by their endings, and reading them."""

from tilestream.formats.routes.arc_length import resample, route_of
from tilestream.formats.routes.lanelet_tags import with_tags
from tilestream.formats.routes.lanes import Lane, read_lanes
from tilestream.formats.routes.reading import READERS, read_all_routes, read_route, read_routes
from tilestream.formats.routes.routes_read import RoutesRead, read_each, together
from tilestream.formats.routes.write import write_geojson_route, write_tum

__all__ = [
    "READERS",
    "Lane",
    "RoutesRead",
    "read_all_routes",
    "read_each",
    "read_lanes",
    "read_route",
    "read_routes",
    "resample",
    "route_of",
    "together",
    "with_tags",
    "write_geojson_route",
    "write_tum",
]
