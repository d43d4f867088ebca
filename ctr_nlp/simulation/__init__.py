"""Robots moved through configurations, as numbers: shapes, margins, snaps. Knows no program."""
