"""The way out: what a run found, as one page for people and as files for programs.

```
findings --> judgement (segments, worst places) --> summary --+--> exports (parquet, geojson, …)
                                                              +--> charts, pictures --> page
```
"""

from tilestream.report.findings import Findings
from tilestream.report.judgement import gate
from tilestream.report.places import cards
from tilestream.report.write import write_report

__all__ = ["Findings", "cards", "gate", "write_report"]
