"""Commands on loaded robots."""
