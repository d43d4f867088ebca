"""The elastic model of a robot under a load: its equilibria, its shape, and its stability."""
