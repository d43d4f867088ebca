"""One figure or table of the paper a file."""
