"""Plans as files of other programs, and their configurations as plans. Knows nothing of machines or of options."""
