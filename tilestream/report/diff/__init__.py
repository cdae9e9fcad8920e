"""Two maps beside each other: what of the estimates changed, why, and whether it may be released.

```
data (MapDiff) --+--> gate ----+
                 +--> summary -+--> map, profile --> page --> write
```
"""
