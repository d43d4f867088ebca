"""A page of plans that opens offline in a browser. Knows plans, and needs the extra `report`."""

from ctr_nlp.view.report.page import page

__all__ = ["page"]
