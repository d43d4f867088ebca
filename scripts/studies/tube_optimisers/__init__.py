"""Tube design beside general optimisers of the same robot; knows designs, and neither options nor folders."""
