"""Pictures, page and exports show the walls themselves, each as what it is."""

import json
from dataclasses import replace

import numpy as np
import pytest
from common import named_problem
from paths.test_wall_surfaces import tube

from ctr_nlp import solve_per_frame
from ctr_nlp.anatomy.distance_fields import field_of_surface
from ctr_nlp.paths.surface import Surface
from ctr_nlp.paths.walls import Body
from ctr_nlp.view.exchange.gltf import encode_gltf
from ctr_nlp.view.exchange.plan_surfaces import INSCRIBED_TUBE_NAME, wall_surfaces
from ctr_nlp.view.exchange.slicer import slicer_files
from ctr_nlp.view.figures.overlay import shapes
from ctr_nlp.view.figures.parts.palette import KEEP_OUT_COLOUR
from ctr_nlp.view.report.page import page


@pytest.fixture(scope="module")
def plan():
    """A plan of three frames inside of a tube of 5 mm radius, and away from another tube beside it."""
    inside = tube()
    beside = Surface(inside.vertices * [0.4, 0.4, 1.0] + [10.0, 0.0, 0.0], inside.triangles)
    bodies = (
        Body("airway [/left] </script>", field_of_surface(inside), surface=inside),
        Body("artery", field_of_surface(beside), keep_out=True, margin=0.5, surface=beside),
    )
    return solve_per_frame(replace(named_problem("line", 3), walls=bodies), model="dominant")


def test_the_surface_is_drawn_and_not_the_tube_around_the_path(plan):
    surfaces = wall_surfaces(plan)
    assert list(surfaces) == ["airway [/left] </script>", "artery"]
    points = surfaces["airway [/left] </script>"].points
    assert np.abs(np.linalg.norm(points[:, :2], axis=1) - 5.0).max() < 0.06
    without = replace(plan, walls=plan.walls[1:])
    assert list(wall_surfaces(without)) == ["artery"]
    lumen = np.column_stack([plan.target[-1], np.full(101, 4.0)])
    assert list(wall_surfaces(replace(without, lumen=lumen))) == [INSCRIBED_TUBE_NAME, "artery"]
    assert list(wall_surfaces(replace(plan, lumen=lumen))) == list(surfaces)


def test_the_page_has_every_wall_and_shows_names_as_text(plan):
    text = page([plan])
    assert text.count("<script") == 2
    assert "airway [/left] </script>" not in text
    assert "artery" in text


def test_slicer_gets_each_kind_of_wall_as_a_file_of_its_own(plan, tmp_path):
    pyvista = pytest.importorskip("pyvista")
    found = slicer_files(replace(plan, to_robot=np.eye(4)))
    assert {"wall.vtp", "keep_out.vtp"} <= set(found)
    assert "inscribed_tube.vtp" not in found
    for name, radius, middle in (("wall.vtp", 5.0, 0.0), ("keep_out.vtp", 2.0, 10.0)):
        (tmp_path / name).write_text(found[name])
        points = pyvista.read(tmp_path / name).points
        assert np.linalg.norm(points[:, :2] - [middle, 0.0], axis=1) == pytest.approx(radius, abs=0.06)


def test_gltf_names_walls_and_colours_what_is_kept_out_of(plan):
    content = encode_gltf(plan)
    told = json.loads(content[20 : 20 + int.from_bytes(content[12:16], "little")])
    names = [node["name"] for node in told["nodes"]]
    assert {"airway [/left] </script>", "artery"} <= set(names)
    colours = {each["name"]: each["pbrMetallicRoughness"]["baseColorFactor"][:3] for each in told["materials"]}
    shades = np.array([int(KEEP_OUT_COLOUR[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    assert colours["artery"] == pytest.approx(((shades + 0.055) / 1.055) ** 2.4)


def test_the_picture_of_shapes_has_a_key_to_both_kinds(plan):
    figure = shapes(plan, frames=[3])
    assert {"lumen", "keep out"} <= {text.get_text() for text in figure.legends[0].get_texts()}
