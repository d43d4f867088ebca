"""The fixed palette, seen by colour-blind eyes and in a greyscale print."""

from itertools import combinations, pairwise

import numpy as np
import pytest
from colorspacious import cspace_convert, deltaE
from matplotlib import colormaps
from matplotlib.colors import to_rgb

from ctr_nlp.view.figures.parts.palette import (
    CLEARANCE_COLOUR_MAP,
    CONTACT,
    ERROR_COLOUR_MAP,
    TILT_COLOURS,
    TUBE_COLOURS,
)

EYES = (None, "deuteranomaly", "protanomaly", "tritanomaly")
DISTINCT = 10.0
"""Least distance in CAM02-UCS, where 1 is just noticed."""


def seen(colours, eyes):
    rgb = np.array([to_rgb(colour) for colour in colours])
    if eyes is None:
        return rgb
    return np.clip(cspace_convert(rgb, {"name": "sRGB1+CVD", "cvd_type": eyes, "severity": 100}, "sRGB1"), 0, 1)


def lightness(colours):
    """0 black to 100 white."""
    return cspace_convert(np.array([to_rgb(colour) for colour in colours]), "sRGB1", "CIELab")[:, 0]


@pytest.mark.parametrize("eyes", EYES)
@pytest.mark.parametrize("colours", [TUBE_COLOURS[:4], TILT_COLOURS], ids=["tubes", "tilt"])
def test_colours_of_one_picture_differ_for_all_eyes(colours, eyes):
    rgb = seen(colours, eyes)
    assert min(deltaE(a, b, input_space="sRGB1") for a, b in combinations(rgb, 2)) > DISTINCT


def test_neighbouring_tubes_differ_in_a_greyscale_print():
    assert min(abs(a - b) for a, b in pairwise(lightness(TUBE_COLOURS))) > DISTINCT
    assert abs(np.subtract(*lightness(TILT_COLOURS))) > DISTINCT


@pytest.mark.parametrize("eyes", EYES)
def test_scales_grow_steadily_lighter_and_contact_stands_out(eyes):
    for scale in (colormaps[ERROR_COLOUR_MAP], CLEARANCE_COLOUR_MAP):
        rgb = seen(scale(np.linspace(0, 1, 33)), eyes)
        grown = np.diff(cspace_convert(rgb, "sRGB1", "CIELab")[:, 0])
        assert (grown > 0).all()
    contact, *free = seen([CONTACT, CLEARANCE_COLOUR_MAP(0.0), colormaps[ERROR_COLOUR_MAP](1.0)], eyes)
    assert min(deltaE(contact, colour, input_space="sRGB1") for colour in free) > 2 * DISTINCT
    assert abs(np.subtract(*lightness([CONTACT, CLEARANCE_COLOUR_MAP(0.0)]))) > 2 * DISTINCT
