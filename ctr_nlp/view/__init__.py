"""Views of a plan for people and other programs: figures, a report page, live steering, exchange files."""
