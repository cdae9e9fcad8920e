"""The way out: what a run found, as one page for people and as files for programs.

```
data (Findings) --> segments (worst places) --> summary --+--> exports/ (parquet, geojson, …)
                                                          +--> charts, pictures --> page --> HTML
comparison (Comparison) ----------------------------------+                (templates/)
diff/ (MapDiff: two maps beside each other)
```
"""

from tilestream.report.data import Findings
from tilestream.report.diff.gate import diff_gate
from tilestream.report.diff.write import write_diff
from tilestream.report.gate import gate
from tilestream.report.summary import cards
from tilestream.report.write import write_comparison, write_report

__all__ = [
    "Findings",
    "cards",
    "diff_gate",
    "gate",
    "write_comparison",
    "write_diff",
    "write_report",
]
