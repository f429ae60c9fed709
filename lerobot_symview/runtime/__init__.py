"""Command lines, worker processes and partial results: what every console command shares."""
