"""Report on which ends of airways are reached by which plans: a page, a table and a figure."""
