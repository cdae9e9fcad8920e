"""A city to try everything in: real footprints, a survey of it, and drives through it.

`footprints` -> `streets` -> `ground`, `buildings`, `furniture`, `structures` -> `city`, the scene
that `raycast` casts rays at; `lidar` measures it, `survey` maps it, `drive` drives through it.
A room of this floor returns arrays; the dataflow writes the files.
"""
