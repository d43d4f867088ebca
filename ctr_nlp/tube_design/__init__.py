"""Co-design: tubes chosen together with the motions of several tasks. Imports plans and searches, no figures or
devices.
"""

from ctr_nlp.tube_design.co_design import Design, design

__all__ = ["Design", "design"]
