"""tilestream: the localization error of a LiDAR vehicle at every metre, from the map alone.

```
files -> points -> tile store -> cells -> factors per sample point --+
scans -> 317 registrations each -------> error per sample point -----+-> forest -> error everywhere
```
"""

from tilestream.dataflow.ingest_map import ingest as ingest
from tilestream.records import Cells as Cells
from tilestream.sensors import HDL64 as HDL64
from tilestream.sensors import OS1_128 as OS1_128
from tilestream.sensors import VLP16 as VLP16
from tilestream.sensors import Sensor as Sensor
from tilestream.store import Tile as Tile
from tilestream.store import TileStore as TileStore
from tilestream.store import open_store as open_store
from tilestream.tiling import TileKey as TileKey
from tilestream.version import VERSION

__version__ = VERSION
