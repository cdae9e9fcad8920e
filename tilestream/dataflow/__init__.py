"""The dataflow over tiles: plan (what will run), tasks (their bodies), run (how)."""
