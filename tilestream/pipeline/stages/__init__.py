"""A file per stage: its function, what it reads and writes, and what that takes."""
