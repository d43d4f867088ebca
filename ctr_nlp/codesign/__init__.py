"""Co-design: tubes chosen together with the motions of several tasks. Imports plans and searches, no figures or
devices.
"""

from ctr_nlp.codesign.together import Design, design

__all__ = ["Design", "design"]
