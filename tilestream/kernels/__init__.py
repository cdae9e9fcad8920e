"""Numbers only: arrays in, arrays out. Each kernel is a formula with units and source.

Loops, files and errors belong to the callers. Every kernel has a plain NumPy twin in the tests.
"""
