"""CasADi functions as machine code, compiled once and kept. Knows no robot and no nonlinear program."""
