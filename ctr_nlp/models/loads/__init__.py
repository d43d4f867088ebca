"""What pulls at a robot, turns it and weighs it down, in N, N mm, N/mm and g/cm^3. Knows robots, and no model."""

from ctr_nlp.models.loads.load import Load
from ctr_nlp.models.loads.modulus import check_moduli, with_modulus
from ctr_nlp.models.loads.over_time import LoadOverTime, load_from_dict, read_load, require_constant_load

__all__ = [
    "Load",
    "LoadOverTime",
    "check_moduli",
    "load_from_dict",
    "read_load",
    "require_constant_load",
    "with_modulus",
]
