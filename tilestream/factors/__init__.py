"""The factors: what the map says, at a place, about how well a lidar can be localized there.

A file per criterion (the paper, section V). Each defines three names:

* `COLUMNS`: its columns, documented (`tilestream.records.Column`), in the order of the definitions.
* `terms(cells, points_mm, cell_of_point) -> dict`: what a cell adds to the sums, independent of the
  sample point. `cells` are a tile's cells with those of a halo around it; `points_mm` are the map
  points (n, 3) [mm] of the tile's core; `cell_of_point` is the row of the cell whose voxel holds
  each of them, -1 for none. Each array of the result has a row per cell of `cells` (the caller
  drops the rows of the halo, so their values do not matter) and one number per cell, or 441.
  Whole numbers are summed as they are; floats are rounded to fixed point (`vicinity.py`), so that
  the sums of a vicinity are the same bits in any order. The values of a cell must not depend on
  the order of the points, nor on what else is in the halo.
* `factors(sums) -> dict`: how the sums of the terms over a vicinity become the columns. `sums` has,
  by name, every term of every criterion summed over the cells of V(P), and what `vicinity.py` adds
  that depends on P: one row per sample point, float64 (k,) or (k, 441). Without cells all sums are
  0, and a mean over nothing is NaN (`vicinity.ratio`).
"""
