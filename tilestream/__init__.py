"""tilestream: the localization error of a LiDAR vehicle at every metre, from the map alone."""

__version__ = "0.1.0.dev0"
