"""Multi-start of a horizon: which motions it is solved from, how far, and with what result; no plans here."""
