"""Files of points: a file per format, each of the protocol in `formats/base.py`."""
