"""What is made of the jobs' results."""
