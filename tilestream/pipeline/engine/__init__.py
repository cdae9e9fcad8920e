"""What every stage has in common: identity, needs, reading, skipping, running, writing, marking."""
