"""Infrastructure of the console commands: command lines, worker processes and atomic results."""
