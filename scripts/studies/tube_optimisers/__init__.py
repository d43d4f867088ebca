"""Comparison of tube design with general-purpose optimisers of the same tubes."""
