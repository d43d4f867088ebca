"""Output folders and files, written whole or not at all. Knows names of files, and not what is in them."""
