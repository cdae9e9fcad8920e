"""How the files of a run directory are called."""

RECORD = "run.json"
"""What a run did, and its state."""
CONFIG = "config.yaml"
"""The settings of the job."""
DATASET = "tables/samples/dataset.parquet"
"""What its model is trained on."""
INVENTORY = "inventory.json"
"""What a folder of tables holds."""
TABLES = ("factors", "observability", "errors", "predictions")
"""Tables that are told of, with their rows; the first that is there gives the extent."""
