"""Sections of the reproduction, in the paper's order: one file for each figure or table."""

from __future__ import annotations

from paper.parts import fig3, fig4, fig6, fig7, fig10, table2
from paper.section import PaperSection

SECTIONS: dict[str, PaperSection] = {
    section.name: section
    for section in (
        fig3.FIG3,
        fig4.FIG4,
        table2.TABLE_II,
        fig6.FIG5,
        fig6.FIG6,
        fig7.FIG7,
        fig7.FIG8,
        fig4.FIG9,
        fig10.FIG10,
    )
}
"""All sections by the names that options use."""
