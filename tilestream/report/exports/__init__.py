"""The places and stretches of a report as files for other people's programs.

```
tables (GeoParquet, CSV, GeoJSON, PCD) --------------------+
geometry, qgis_styles, labels --> geopackage --------------+--> write
labels --> foxglove (MCAP) --------------------------------+
lanelets (a Lanelet2 map with tags) -----------------------+
```
"""
