"""Plans, and what is known about a motion: errors, contacts, limits used, verdicts. Knows no solver."""
