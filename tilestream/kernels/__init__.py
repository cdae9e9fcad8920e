"""Numbers only: arrays in, arrays out. Each kernel is a formula with units and source.

Files and errors belong to the callers. Tests compare the kernels with plain NumPy versions.
"""
