"""The way out: what a run found, as one page for people and as files for programs.

```
data (Findings) --> segments (worst places) --> summary --+--> exports (parquet, geojson, …)
                                                          +--> charts, pictures --> page --> HTML
comparison (Comparison) ----------------------------------+                (templates/)
```
"""

from tilestream.report.data import Findings
from tilestream.report.gate import gate
from tilestream.report.summary import cards
from tilestream.report.write import write_comparison, write_report

__all__ = ["Findings", "cards", "gate", "write_comparison", "write_report"]
