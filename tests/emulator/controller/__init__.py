"""The firmware in layers: each file adds one ability to the controller below it."""
