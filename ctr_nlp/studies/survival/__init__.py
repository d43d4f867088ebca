"""Report on plans of many airways on perturbed robots: nominal at several stability margins, and robust."""
