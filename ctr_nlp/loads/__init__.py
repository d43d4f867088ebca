"""What pulls at a robot, turns it and weighs it down, in N, N mm and g/cm^3. Knows robots, and no model."""

from ctr_nlp.loads.load import Load
from ctr_nlp.loads.modulus import check_moduli, with_modulus

__all__ = ["Load", "check_moduli", "with_modulus"]
