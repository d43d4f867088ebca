"""Plans as one page that opens offline in a browser; knows plans, and needs the extra `report`."""

from ctr_nlp.view.report.page import page

__all__ = ["page"]
