"""The page of a job on Dask's own dashboard.

```
events (the client's) --> plugin (on the scheduler) --> page --+--> map: tiles, relief, estimates
                                                               +--> words: header, stages, failures
```
"""
