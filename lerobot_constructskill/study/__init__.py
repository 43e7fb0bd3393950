"""A study: specification, runs, execution, rows. Makes what is missing, and names no policy type."""
