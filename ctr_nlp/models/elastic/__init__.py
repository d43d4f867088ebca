"""The elastic model: how tubes twist each other, the shape that this gives, and whether it is stable.

`torsion` integrates the tubes' angles from their tips to the motors, `shape` turns them into a curve, `energy` and
`stability` give the stability margin, `equilibria`, `following` and `walking` follow a robot's branch of
equilibria along motions, and `model` puts these behind the interface of models/protocol.py. Sources: Dupont et al.
2010, Rucker et al. 2010 (the model), Gilbert et al. 2016 (stability).
"""

from ctr_nlp.models.elastic.model import Elastic

__all__ = ["Elastic"]
