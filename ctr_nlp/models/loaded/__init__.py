"""The elastic model of a robot that bears a load: its equilibria, its shape, and whether it is stable."""
