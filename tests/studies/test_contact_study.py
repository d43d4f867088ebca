"""The study that compares plans which lean on a wall with plans that keep off it."""

from dataclasses import replace

import contact
import pytest

from ctr_nlp import Problem, Robot, Tube, curve_from_points, growing
from ctr_nlp.anatomy.formats.vtk import write_vtk
from ctr_nlp.anatomy.lumen_tree import read_lumen_tree
from ctr_nlp.anatomy.synthetic_tree import synthetic_tree
from ctr_nlp.support.tables import write_csv

ROD = Robot((Tube(200, 150, 0.0, 1.5, 1.0, youngs_modulus=60_000),))


def test_ends_come_narrowest_first_and_only_those_that_the_robot_reaches(tmp_path):
    write_vtk(tmp_path / "tree.vtp", synthetic_tree(0, 12))
    tree = read_lumen_tree(tmp_path / "tree.vtp")
    found = contact.narrowest_ends(tree, ROD)
    lengths = {end.number: end.path.length for end in tree.ends}
    short = Robot((replace(ROD.tubes[0], length=sum(lengths.values()) / len(lengths), curved_length=20),))
    assert len(found) > 1
    assert sorted(room for _, room in found) == [room for _, room in found]
    for end, room in found:
        assert room == pytest.approx(tree.find_narrowest(tree.ends[end - 1], ROD).margin)
    kept = [end for end, _ in contact.narrowest_ends(tree, short)]
    assert 0 < len(kept) < len(lengths)
    assert all(lengths[end] <= short.tubes[0].length for end in kept)


@pytest.mark.slow
def test_a_straight_rod_presses_less_where_its_plan_leans_on_the_wall():
    bend = curve_from_points([[0, 0.002 * z**2, z] for z in range(0, 101, 5)], [1.5] * 21)
    row = contact.compare_plans(Problem("rod", ROD, growing(bend, 3)), 0.2)
    assert 0 < row["leans_force_N"] <= row["avoids_force_N"]
    assert set(row) < set(contact.COLUMNS)


def test_a_table_is_summed_up_robot_by_robot(tmp_path, capsys):
    table = tmp_path / "rows.csv"
    numbers = {"robot": "thin", "avoids_reached": "no", "leans_reached": "yes", "avoids_tip_mm": 1.0}
    each = (
        {"end": 1, "avoids_force_N": 0.4, "leans_force_N": 0.2, "leans_tip_mm": 1.9},
        {"end": 2, "avoids_force_N": "snaps", "leans_force_N": 0.1, "leans_tip_mm": 0.1},
        {"end": 3, "avoids_force_N": 0.2, "leans_force_N": 0.2, "leans_tip_mm": 0.1},
        {"end": 4, "avoids_force_N": 0.2, "leans_force_N": 0.1, "leans_tip_mm": 2.1},
    )
    halves = {"halves_force_N": 0.1, "halves_tip_mm": 0.1}
    write_csv(table, [dict.fromkeys(contact.COLUMNS, "") | numbers | one for one in (*each, each[2] | halves)])
    rows = contact.read_rows(table)
    assert [row["end"] for row in rows] == ["1", "2", "3", "4", "3"]
    contact.summarise(rows)
    told = capsys.readouterr().out
    assert "thin: 5 ends, 0 reached free of the wall, 5 leaning on it" in told
    assert "2 of 4 are reached as near with half of the largest force" in told
