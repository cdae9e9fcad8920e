"""What a run knows, as files that a vehicle's software reads."""
