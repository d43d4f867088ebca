"""What the scripts share; each script's own `main` is a file here."""
