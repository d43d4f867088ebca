"""Walls from masks and meshes: where they are, what is inside of them, and what is refused."""

import nibabel
import numpy as np
import pytest

from ctr_nlp import WallFile, problem_from_file, read_wall, solve_per_frame
from ctr_nlp.anatomy.lumen_surfaces import open_ends, wall_around_path
from ctr_nlp.cli.commands.inspect import main as inspect
from ctr_nlp.cli.commands.plan import steer
from ctr_nlp.exceptions import CurveError, OptionError, ProblemError
from ctr_nlp.paths.surface import Surface

pyvista = pytest.importorskip("pyvista", reason='needs pyvista: pip install -e ".[anatomy]"')

PATH = np.column_stack([np.full(61, 10.0), np.full(61, -20.0), np.arange(61.0)])
MIRROR = np.array([-1.0, -1.0, 1.0])


def cylinder(radius=5.0, low=-15.0, high=75.0, capped=True):
    """A mesh around PATH, from z = low to z = high."""
    middle = (10, -20, (low + high) / 2)
    size = {"radius": radius, "height": high - low, "resolution": 40}
    return pyvista.Cylinder(center=middle, direction=(0, 0, 1), capping=capped, **size).triangulate()


def write_path(folder):
    file = folder / "path.csv"
    table = np.column_stack([PATH, np.full(len(PATH), 3.0)])
    np.savetxt(file, table, delimiter=",", header="x_mm,y_mm,z_mm,radius_mm", comments="")
    return file


def write_mask(file, low=0.0, high=60.0, radius=5.0, label=1):
    """A mask of a cylinder around PATH, in RAS, with voxels of 0.8 mm."""
    affine = np.diag([0.8, 0.8, 0.8, 1.0])
    affine[:3, 3] = [-10 - 12, 20 - 12, -12]
    index = np.stack(np.meshgrid(np.arange(31), np.arange(31), np.arange(106), indexing="ij"), axis=-1)
    points = index * 0.8 + affine[:3, 3]
    across = np.linalg.norm(points[..., :2] - [-10, 20], axis=-1)
    inside = (across < radius) & (points[..., 2] > low) & (points[..., 2] < high)
    nibabel.save(nibabel.Nifti1Image((label * inside).astype(np.uint8), affine), file)
    return file


# Bodies


@pytest.mark.parametrize("suffix", ["stl", "vtp", "vtk", "ply"])
def test_a_mesh_to_keep_out_of(tmp_path, suffix):
    file = tmp_path / f"node.{suffix}"
    pyvista.Sphere(radius=4, center=(10, -10, 30), theta_resolution=60, phi_resolution=60).save(file)
    body = read_wall(file, margin=1.5)
    assert body.name == "node"
    found = body.room(np.array([[10.0, -20, 30], [10, -12, 30]]))
    np.testing.assert_allclose(found, [10 - 4 - 1.5, -2 - 1.5], atol=0.05)
    np.testing.assert_allclose(body.sign * body.field.evaluate(np.array([[10.0, -15, 30]]))[0], 1, atol=0.1)


def test_space_of_a_mesh_is_stated_or_given(tmp_path):
    mesh = pyvista.Sphere(radius=4, center=(-10, 10, 30))
    mesh.save(tmp_path / "given.stl")
    mesh.field_data["SPACE"] = ["RAS"]
    mesh.save(tmp_path / "stated.vtp")
    for body in (read_wall(tmp_path / "given.stl", space="RAS"), read_wall(tmp_path / "stated.vtp")):
        assert body.room(np.array([[10.0, -10, 30]]))[0] == pytest.approx(-4, abs=0.1)


def test_a_mask_to_keep_out_of_by_its_label(tmp_path):
    file = write_mask(tmp_path / "vessel.nii.gz", label=3)
    body = read_wall(file, label=[3])
    assert body.name == "vessel"
    assert body.room(np.array([[18.0, -20, 30]]))[0] == pytest.approx(3, abs=0.2)
    with pytest.raises(CurveError, match="no voxel has the label 4"):
        read_wall(file, label=[4])


def test_surface_near_points_for_pictures(tmp_path):
    cylinder(radius=9).save(tmp_path / "lung.stl")
    body = read_wall(tmp_path / "lung.stl", keep_out=False)
    part = body.surface_near(PATH[:5], within=35.0)
    assert 0 < len(part.triangles) <= len(body.surface.triangles)
    with pytest.raises(ProblemError, match="asked for"):
        body.surface_near(PATH + 500)


# Lumens


def test_the_surface_of_a_mask_is_the_wall_of_its_problem(tmp_path):
    file = write_mask(tmp_path / "airway.nii.gz")
    ends = {"entry": PATH[1] * MIRROR, "target": PATH[58] * MIRROR}
    problem = problem_from_file(file, frames=3, **ends)
    (body,) = problem.walls
    assert body.name == "airway"
    assert any("surface of the mask" in note for note in problem.notes)
    assert any("entry and the target" in note for note in problem.notes)
    # The mask ends at both ends of the path: there is no lid, neither for verdicts nor for programs.
    target = problem.target_frames[-1].points
    np.testing.assert_allclose(body.room(target), 5.0, atol=0.4)
    assert (body.field.evaluate(target)[0] > 3.5).all()
    round_lumen = problem_from_file(file, frames=3, wall_of_mask="lumen", **ends)
    assert not round_lumen.walls
    assert any("round lumen" in note for note in round_lumen.notes)


def test_a_lumen_that_goes_on_stays_closed(tmp_path):
    surface = Surface(cylinder().points, cylinder().faces.reshape(-1, 4)[:, 1:])
    assert open_ends(surface, PATH)[1] == []
    short = Surface(cylinder(low=-1, high=62).points, cylinder(low=-1, high=62).faces.reshape(-1, 4)[:, 1:])
    assert open_ends(short, PATH)[1] == ["entry", "target"]


def test_the_inside_of_an_open_thick_walled_mesh_is_found(tmp_path):
    inner, outer = cylinder(radius=5, capped=False), cylinder(radius=7, capped=False)
    across = pyvista.Disc(center=(10, -20, 30), inner=0, outer=5, normal=(0, 0, 1), c_res=60).triangulate()
    mesh = (inner + outer + across).extract_surface(algorithm="dataset_surface").clean()
    mesh.save(tmp_path / "trachea.stl")
    problem = problem_from_file(
        write_path(tmp_path), frames=3, walls=[WallFile(tmp_path / "trachea.stl", keep_out=False)]
    )
    (body,) = problem.walls
    np.testing.assert_allclose(body.room(problem.target_frames[-1].points), 5.0, atol=0.1)
    assert any("lids" in note for note in problem.notes)
    assert any("across the path" in note for note in problem.notes)


def test_a_surface_with_gaps_is_refused():
    sheet = Surface([[12, -40, 0], [12, 0, 0], [12, -20, 60]], [[0, 1, 2]])
    with pytest.raises(CurveError, match="outside of its surface"):
        wall_around_path(sheet, PATH)


# What is refused


def test_a_path_outside_of_a_surface_is_refused(tmp_path):
    mesh = cylinder()
    mesh.points = mesh.points * MIRROR
    mesh.save(tmp_path / "ras.ply")
    near = WallFile(tmp_path / "ras.ply", keep_out=False)
    with pytest.raises(CurveError, match="within 30 mm"):
        problem_from_file(write_path(tmp_path), frames=3, walls=[near])
    apart = cylinder()
    apart.points = apart.points + np.array([0, 12, 0])
    apart.save(tmp_path / "apart.ply")
    with pytest.raises(CurveError, match="outside of its surface"):
        problem_from_file(write_path(tmp_path), frames=3, walls=[WallFile(tmp_path / "apart.ply", keep_out=False)])


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda folder: read_wall(folder / "none.stl"), CurveError, "no such file"),
        (lambda folder: read_wall(folder / "path.csv"), CurveError, "no known kind of mesh"),
        (lambda folder: read_wall(folder / "bad.stl"), CurveError, "mesh|triangles"),
        (lambda folder: read_wall(folder / "node.stl", margin=-1), OptionError, "margin of .*node.stl is -1"),
        (lambda folder: read_wall(folder / "node.stl", label=[1]), OptionError, "label goes with a mask"),
        (
            lambda folder: problem_from_file(folder / "path.csv", frames=2, walls=["node.stl"]),
            OptionError,
            "a wall is 'node.stl'",
        ),
        (
            lambda folder: problem_from_file(
                folder / "path.csv", frames=2, walls=[WallFile(folder / "node.stl")] * 2
            ),
            ProblemError,
            "name of its own",
        ),
        (
            lambda folder: problem_from_file(folder / "path.csv", frames=2, wall_of_mask="surface"),
            OptionError,
            "goes with a mask",
        ),
    ],
)
def test_what_is_no_wall_is_refused(tmp_path, make, error, message):
    write_path(tmp_path)
    (tmp_path / "bad.stl").write_bytes(b"solid nothing")
    pyvista.Sphere(radius=2, center=(10, -10, 30)).save(tmp_path / "node.stl")
    with pytest.raises(error, match=message):
        make(tmp_path)


# The command line


@pytest.mark.interpreted
def test_options_for_walls_reach_the_verdict(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    write_path(tmp_path)
    pyvista.Sphere(radius=2, center=(10, -12, 30)).save("node.stl")
    write_mask(tmp_path / "vessel.nii.gz", radius=2, label=3)
    cylinder(radius=6).save("lung.ply")
    status = steer(
        [
            *("path.csv", "--frames", "3", "--no-evaluate", "--no-figures", "--model", "dominant", "--out", "out"),
            *("--keep-out", "node.stl=1", "vessel.nii.gz:3", "--inside", "lung.ply"),
        ]
    )
    assert status == 1
    told = " ".join(capsys.readouterr().out.split())
    for name in ("node:", "vessel:3", "lung"):
        assert name in told
    # The path leads through the vessel.
    assert "within the wall" in told


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["arc", "--keep-out", "a.stl"], "--keep-out goes with a centreline file"),
        (["path.csv", "--keep-out", "a.stl"], "there is no file 'a.stl'"),
        (["path.csv", "--inside", "path.csv=wide"], "margin is 'wide'"),
        (["path.csv", "--wall-of-mask", "lumen"], "goes with a mask"),
    ],
)
def test_bad_options_for_walls_are_refused(tmp_path, monkeypatch, capsys, given, message):
    monkeypatch.chdir(tmp_path)
    write_path(tmp_path)
    assert steer(given) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_inspection_says_which_wall_a_mask_has(tmp_path, capsys):
    file = write_mask(tmp_path / "airway.nii.gz")
    ends = [["--entry", *map(str, PATH[3] * MIRROR)], ["--target", *map(str, PATH[55] * MIRROR)]]
    assert inspect([str(file), *ends[0], *ends[1]]) == 0
    assert "the wall is the surface of the mask" in " ".join(capsys.readouterr().out.split())


# A mesh of four parts, with walls inside of the lumen


def test_a_mesh_with_inner_walls_is_read(shared_data):
    near = WallFile(shared_data / "anatomy" / "hra_vhm_bronchi.stl", keep_out=False)
    problem = problem_from_file(shared_data / "airways" / "hra_vhm_left_main.csv", frames=4, walls=[near])
    (body,) = problem.walls
    path = problem.target_frames[-1]
    assert path.radius is not None
    off = np.abs(body.room(path.points) - path.radius)
    # The radii of the file are distances from the same mesh; where its parts meet, they were interpolated.
    assert np.percentile(off, 80) < 0.2


@pytest.mark.slow
def test_a_motion_within_a_mesh_of_several_parts(shared_data):
    near = WallFile(shared_data / "anatomy" / "hra_vhm_bronchi.stl", keep_out=False)
    problem = problem_from_file(shared_data / "airways" / "hra_vhm_left_main.csv", frames=50, walls=[near])
    plan = solve_per_frame(problem, model="dominant")
    assert plan.complete
    assert plan.clearance.min() > 0
