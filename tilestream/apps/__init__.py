"""What is made on top of the jobs: a view of the map and of what a run found."""
