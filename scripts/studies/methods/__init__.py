"""Comparison of all methods, ours and published ones: figures of their plans, and the page that shows them."""
