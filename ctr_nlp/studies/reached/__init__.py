"""Which airways are reached by which plans: a page, a table and a picture."""
