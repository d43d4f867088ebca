"""A timed motion played on a device: supervision, results, what is trusted, how one goes on or back."""
