"""Logs of drives: scans, poses and frames."""
