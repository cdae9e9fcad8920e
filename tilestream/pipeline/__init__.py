"""The dataflow: `engine` runs tasks of any kind, `stages` says what each does, `jobs` puts them
together.
"""
