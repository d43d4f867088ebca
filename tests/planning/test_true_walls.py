"""What plans say of their contact with true walls, beside meshes and distances of VTK."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from ctr_nlp import WallFile, problem_from_file, solve_per_frame
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.exceptions import CtrError
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.plan.measures import find_deepest_point
from ctr_nlp.plan.simulation import shapes_between

nibabel = pytest.importorskip("nibabel", reason='needs nibabel: pip install -e ".[anatomy]"')
pyvista = pytest.importorskip("pyvista", reason='needs pyvista: pip install -e ".[anatomy]"')

LPS_TO_RAS = np.array([-1.0, -1.0, 1.0])
MASK, TREE = "chaste_ts002_airways_uneven.nii.gz", "chaste_ts002_tree.vtp"
LOBES = "rul", "rml", "rll", "lul", "lll"


def vtk_distances(mesh, points):
    """Distances of points from a mesh by VTK, positive inside where its normals point outwards."""
    function = pyvista._vtk.vtkImplicitPolyDataDistance()
    function.SetInput(mesh)
    return -np.array([function.EvaluateFunction(point) for point in points])


def bodies_between(plan):
    """Points of the robot's centreline in frames and between them, in the file's coordinates, and its radii."""
    found = shapes_between(plan.robot, plan.q, plan.evaluated_model)
    back = np.linalg.inv(plan.to_robot)
    points = found.shape @ back[:3, :3].T + back[:3, 3]
    arc_length = SIGMA_GRID * found.beta[:, -1:]
    outermost = (arc_length[..., None] > found.beta[:, None, :-1] + 1e-9).sum(axis=-1)
    radii = np.array([tube.outer_diameter / 2 for tube in plan.robot.tubes])[outermost]
    return points, radii


# Contact within a mask


@pytest.fixture(scope="module")
def airways(shared_data):
    """The surface of the mask at half of its value, smoothed by half a voxel, in RAS."""
    image = nibabel.load(shared_data / "anatomy" / MASK)
    smooth = gaussian_filter(np.pad(np.asarray(image.dataobj) > 0, 2).astype(np.float32), 0.5)
    grid = pyvista.ImageData(dimensions=smooth.shape)
    grid.point_data["mask"] = smooth.ravel(order="F")
    mesh = grid.contour([0.5], scalars="mask", method="flying_edges", compute_normals=False)
    mesh.points = (np.asarray(mesh.points) - 2) @ image.affine[:3, :3].T + image.affine[:3, 3]
    # The image's first two axes run against those of RAS, so that triangles keep their sense.
    assert np.linalg.det(image.affine[:3, :3]) > 0
    return mesh


@pytest.fixture(scope="module")
def ends(shared_data):
    """Entry and end, in RAS, of every branch of the tree within the mask, deeper than 60 mm."""
    found = []
    for branch in read_branches(shared_data / "anatomy" / TREE).branches:
        narrow = np.flatnonzero(branch.radius < 0.95)
        points = branch.points[: narrow[0] if narrow.size else None] * LPS_TO_RAS
        deep = np.linalg.norm(np.diff(points, axis=0), axis=1).sum() > 60
        if deep and all(np.linalg.norm(points[-3] - other[1]) > 3 for other in found):
            found.append((points[3], points[-3]))
    return found


def deepest_contacts(shared_data, airways, entry, target, frames=20):
    """The deepest contact that a plan reports, that of VTK, and that of a round lumen, mm; None without a plan."""
    mask = shared_data / "anatomy" / MASK
    try:
        problem = problem_from_file(mask, frames=frames, entry=entry, target=target, trim="start")
    except CtrError:
        return None
    plan = solve_per_frame(problem, model="dominant")
    points, radii = bodies_between(plan)
    # Lids of the mask beyond the path's ends are no wall.
    back = np.linalg.inv(plan.to_robot)
    path = problem.target_frames[-1].points @ back[:3, :3].T + back[:3, 3]
    middles = airways.cell_centers().points
    wall = np.ones(len(middles), bool)
    for line, reach in ((path, 22.0), (path[::-1], 8.0)):
        offset = middles - line[0]
        wall &= ~((offset @ (line[0] - line[2]) > 0) & (np.linalg.norm(offset, axis=1) < reach))
    open_mesh = airways.extract_cells(wall).extract_surface(algorithm="dataset_surface")
    field = problem.walls[0].field
    clear = field.evaluate((points @ plan.to_robot[:3, :3].T + plan.to_robot[:3, 3]).reshape(-1, 3))[0]
    clear = clear.reshape(radii.shape) - radii
    # The true distance of all points takes minutes; far more than the field's error from its deepest none counts.
    near = clear < clear.min() + 1.0
    true = (radii[near] - vtk_distances(open_mesh, points[near])).max()
    lumen = -problem.sampled_lumen.clearance(plan.robot, plan.beta, SIGMA_GRID, plan.shape).min()
    return find_deepest_point(plan).depth, float(true), float(lumen)


@pytest.mark.interpreted
def test_reported_contact_is_the_true_one(shared_data, airways, ends):
    reported, true, _ = deepest_contacts(shared_data, airways, *ends[2], frames=4)
    assert reported == pytest.approx(true, abs=0.15)


@pytest.mark.slow
def test_reported_contact_is_the_true_one_at_every_end(shared_data, airways, ends):
    found = [deepest_contacts(shared_data, airways, *each) for each in ends]
    figures = np.array([each for each in found if each is not None])
    assert len(figures) >= 30
    assert np.abs(figures[:, 0] - figures[:, 1]).max() <= 0.15
    # A round lumen with the path's radius is far from that.
    assert np.median(np.abs(figures[:, 2] - figures[:, 1])) > 0.3


# Bodies to keep out of


def random_body(rng, path, folder, number):
    """A ball or a bent tube at a random distance from a path, as a mesh in a file."""
    at = path[rng.integers(len(path) // 4, len(path))]
    away = rng.normal(size=3)
    away *= rng.uniform(5, 14) / np.linalg.norm(away)
    if rng.random() < 0.5:
        mesh = pyvista.Sphere(radius=rng.uniform(1.5, 5), center=at + away)
    else:
        turn = rng.normal(size=(2, 3)) * 25
        line = pyvista.Spline(np.stack([at + away + turn[0], at + away, at + away + turn[1]]), 60)
        mesh = line.tube(radius=rng.uniform(1, 3), n_sides=24, capping=True).triangulate()
    file = folder / f"body_{number}.ply"
    mesh.save(file)
    return file


def plan_beside_bodies(shared_data, folder, seed, frames=15):
    """A plan on the elastic model's shapes that keeps out of random bodies, and their files with margins."""
    rng = np.random.default_rng(seed)
    name = rng.choice(["chaste_ts002_LLL", "chaste_ts002_RLL", "chaste_ts002_RML"])
    file = shared_data / "airways" / f"{name}.csv"
    path = np.loadtxt(file, delimiter=",", skiprows=1)[:, :3]
    chosen = [random_body(rng, path, folder, k) for k in range(rng.integers(1, 4))]
    if rng.random() < 0.5:
        chosen.append(shared_data / "anatomy" / f"chaste_ts002_{rng.choice(LOBES)}.stl")
    walls = []
    for body in chosen:
        wall = WallFile(body, margin=rng.uniform(0, 2))
        # Bodies that the path leads through, or that are far away, settle nothing.
        try:
            through = bool(wall.read(path).notes[1:])
        except CtrError:
            continue
        if not through:
            walls.append(wall)
    # Without the radii: with them contact with the lumen settles nearly every verdict.
    problem = replace(problem_from_file(file, frames=frames, walls=walls), lumen=None)
    return solve_per_frame(problem, model="dominant").evaluate_on("elastic"), walls


def assert_margins_are_kept(plan, walls):
    """Where the verdict is *yes*, no point is nearer to a body than its margin, by VTK; returns the verdict."""
    word = plan.verdicts.within_wall.word
    if word != "yes":
        return word
    points, radii = bodies_between(plan)
    for wall in walls:
        mesh = pyvista.read(wall.path).clean()
        low, high = np.array(mesh.bounds).reshape(3, 2).T
        outside = np.linalg.norm(np.maximum(0, np.maximum(low - points, points - high)), axis=-1)
        near = outside < radii + wall.margin + 1
        if near.any():
            clear = -vtk_distances(mesh, points[near]) - radii[near]
            assert clear.min() >= wall.margin - 1e-3
    return word


@pytest.mark.interpreted
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_margins_are_kept_where_the_verdict_says_so(shared_data, tmp_path, seed):
    assert_margins_are_kept(*plan_beside_bodies(shared_data, tmp_path, seed, frames=4))


@pytest.mark.slow
def test_margins_are_kept_in_two_hundred_plans(shared_data, tmp_path):
    words = []
    for seed in range(200):
        folder = tmp_path / str(seed)
        folder.mkdir()
        words.append(assert_margins_are_kept(*plan_beside_bodies(shared_data, folder, seed)))
    assert words.count("yes") >= 20
