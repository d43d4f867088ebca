"""Which motions a horizon is solved from, and what comes of them; knows no plan."""
