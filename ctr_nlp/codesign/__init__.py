"""Tubes chosen together with the motions of several tasks; knows plans and searches, and neither pictures nor
devices.
"""

from ctr_nlp.codesign.together import Design, design

__all__ = ["Design", "design"]
