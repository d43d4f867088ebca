"""Plans in files of other programs: the same points, as readers that are not ours see them."""

from __future__ import annotations

import csv
import importlib.util
import io
import json
import struct
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.io import loadmat

from ctr_nlp import Problem, curve_from_formula, growing, table_i_robot
from ctr_nlp.anatomy.files import read_branches
from ctr_nlp.anatomy.problem_files import problem_from_file
from ctr_nlp.cli.commands.export import main
from ctr_nlp.cli.main import COMMANDS, load
from ctr_nlp.exceptions import OptionError, OutputError
from ctr_nlp.hardware.exports import MACHINE_FORMATS
from ctr_nlp.plan.metrics import by_frame, summary
from ctr_nlp.plan.summary_text import NOT_FOR_PATIENTS
from ctr_nlp.view.exchange.configurations import plan_through
from ctr_nlp.view.exchange.formats import EXCHANGE_FORMATS, FILE_FORMATS
from ctr_nlp.view.exchange.gltf import encode_gltf
from ctr_nlp.view.exchange.mat import encode_mat
from ctr_nlp.view.exchange.plan_surfaces import tube_surfaces, wall_surfaces
from ctr_nlp.view.exchange.shapes_csv import encode_shapes_csv
from ctr_nlp.view.exchange.slicer import slicer_files

FRAMES = 5
CLOSE = 0.01
"""mm by which a point in a file may be off."""
PLACE = np.array([12.0, -160.0, 1210.0])
"""Where the path begins in the scan, LPS, mm."""
TO_LPS = {"LPS": np.diag([1.0, 1.0, 1.0]), "RAS": np.diag([-1.0, -1.0, 1.0])}


def path(s):
    """A bent path in the scan, LPS, mm, that leads down, forwards and to the left."""
    return PLACE + np.column_stack([0.004 * s**2, -0.2 * s + 0.001 * s**2, -s])


def moved_through(problem):
    """A plan that comes out of its insertion point, turns and tilts."""
    t = np.linspace(0.2, 1.0, problem.frames)
    q = np.column_stack(
        [0.3 * t, -0.2 * t, 1 + t, 0 * t + 20 * (t > 0.5), 20 + 30 * t, 40 + 60 * t, 0.1 * t, -0.2 * t]
    )
    return plan_through(problem, q, model="dominant")


@pytest.fixture(scope="module", params=["LPS", "RAS"])
def scanned(request, tmp_path_factory):
    """A plan along a centreline that 3D Slicer has saved in a scan's coordinates, and the name of these."""
    folder, s = tmp_path_factory.mktemp("scan"), np.linspace(0.0, 130.0, 60)
    points = path(s) @ TO_LPS[request.param]
    markup = {
        "type": "Curve",
        "coordinateSystem": request.param,
        "controlPoints": [{"position": point} for point in points.tolist()],
        "measurements": [{"name": "Radius", "units": "mm", "controlPointValues": [6.0] * len(s)}],
    }
    (folder / "scan.mrk.json").write_text(json.dumps({"markups": [markup]}))
    problem = problem_from_file(folder / "scan.mrk.json", frames=FRAMES, trim="end")
    return moved_through(problem), request.param


@pytest.fixture(scope="module")
def plan():
    curve = curve_from_formula(lambda u: (0.001 * u**2, 0.0, u), 0.0, 110.0)
    return moved_through(Problem("parabola", table_i_robot(), growing(curve, FRAMES), duration=2.0))


@pytest.fixture
def file(plan, tmp_path):
    plan.save(tmp_path / "plan.npz")
    return tmp_path / "plan.npz"


def export(*arguments):
    return main([str(argument) for argument in arguments])


def in_scan(plan, points):
    """Points of the robot's frame in the coordinates of the file, by the transform that the plan keeps."""
    return (points - plan.to_robot[:3, 3]) @ plan.to_robot[:3, :3]


# 3D Slicer


@pytest.fixture(scope="module")
def folder(scanned, tmp_path_factory):
    plan, _ = scanned
    place = tmp_path_factory.mktemp("slicer")
    (place / "frames").mkdir()
    for name, text in slicer_files(plan).items():
        (place / name).write_text(text, encoding="utf-8")
    return place


def test_curves_have_the_points_of_robot_and_target_in_the_scan(scanned, folder):
    plan, space = scanned
    for j in range(FRAMES):
        for name, points in (("robot", plan.shape[j]), ("target", plan.target[j])):
            held = json.loads((folder / "frames" / f"{name}_{j + 1:03d}.mrk.json").read_text())
            (markup,) = held["markups"]
            assert (markup["type"], markup["coordinateSystem"], markup["coordinateUnits"]) == (
                "Curve",
                "LPS",
                "mm",
            )
            found = np.array([control["position"] for control in markup["controlPoints"]])
            assert np.abs(found - in_scan(plan, points) @ TO_LPS[space]).max() < 1e-5
    assert np.abs(found[0] - PLACE).max() < CLOSE  # the target begins where the path does
    s = np.linspace(0.0, 130.0, 20001)
    assert np.linalg.norm(found[:, None, :] - path(s)[None], axis=-1).min(axis=1).max() < CLOSE


class Recorded:
    """In place of a module of Slicer: has every name, can be called, and lists the calls with their arguments."""

    def __init__(self, calls, way=""):
        self._calls, self._way = calls, way

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return Recorded(self._calls, f"{self._way}.{name}")

    def __call__(self, *given):
        self._calls.append((self._way, given))
        return Recorded(self._calls, self._way)

    def __sub__(self, other):
        return self


def test_slicer_says_that_nothing_is_validated(scanned, folder, monkeypatch, capsys):
    """In what the script prints, in the 3D view, in descriptions of nodes and in the files of curves."""
    calls = []
    for name in ("slicer", "vtk"):
        monkeypatch.setitem(sys.modules, name, Recorded(calls, name))
    found = importlib.util.spec_from_file_location("load_in_slicer", folder / "load_in_slicer.py")
    script = importlib.util.module_from_spec(found)
    found.loader.exec_module(script)
    assert script.NOT_FOR_PATIENTS == NOT_FOR_PATIENTS
    assert NOT_FOR_PATIENTS in script.__doc__
    script.load()
    assert capsys.readouterr().out == f"{NOT_FOR_PATIENTS}\n"
    shown = [given for way, given in calls if way.endswith(".cornerAnnotation.SetText")]
    assert [given[-1] for given in shown] == [NOT_FOR_PATIENTS]
    described = [given for way, given in calls if way.endswith(".SetDescription")]
    wall = (folder / "inscribed_tube.vtp").exists()
    assert described == [(NOT_FOR_PATIENTS,)] * (7 + wall)  # the browser, three sequences and what they show
    for file in sorted((folder / "frames").glob("*.mrk.json")):
        (markup,) = json.loads(file.read_text())["markups"]
        assert markup["controlPoints"][0]["description"] == NOT_FOR_PATIENTS


def test_curves_come_back_as_centrelines(scanned, folder):
    plan, _ = scanned
    (branch,) = read_branches(folder / "frames" / f"target_{FRAMES:03d}.mrk.json").branches
    again = problem_from_file(folder / "frames" / f"target_{FRAMES:03d}.mrk.json", frames=FRAMES)
    assert again.space == "LPS"
    assert np.abs(branch.points[0] - PLACE).max() < CLOSE
    assert max(again.target.lengths) == pytest.approx(
        np.linalg.norm(np.diff(plan.target[-1], axis=0), axis=1).sum(), abs=0.1
    )


def test_tubes_lie_around_the_robot_in_the_scan(scanned, folder):
    pyvista = pytest.importorskip("pyvista")
    plan, space = scanned
    for j in range(FRAMES):
        mesh = pyvista.read(folder / "frames" / f"tubes_{j + 1:03d}.vtp")
        assert list(mesh.field_data["SPACE"]) == ["LPS"]
        assert mesh.field_data["TimeValue"][0] == plan.time[j]
        kept = np.vstack([surface.points for surface in tube_surfaces(plan, j).values()])
        assert np.abs(mesh.points - in_scan(plan, kept) @ TO_LPS[space]).max() < 1e-9
        for number in np.unique(mesh.cell_data["tube"]):
            tube = mesh.extract_cells(mesh.cell_data["tube"] == number).extract_surface(algorithm=None)
            tube = tube.clean()  # discs have the points of their rims once more, with normals of their own
            assert tube.n_open_edges == 0
            beta = np.append(0.0, plan.beta[j])
            radius = plan.robot.tubes[number - 1].outer_diameter / 2
            cylinder = np.pi * radius**2 * (beta[number] - beta[number - 1])
            assert tube.volume == pytest.approx(cylinder, rel=0.05)  # less what sixteen corners cut off
            assert tube.volume > 0


def test_the_collection_lists_every_frame_with_its_time(scanned, folder):
    pyvista = pytest.importorskip("pyvista")
    reader = pyvista.get_reader(folder / "tubes.pvd")
    assert reader.time_values == pytest.approx(scanned[0].time.tolist())
    reader.set_active_time_point(2)
    assert reader.read()[0].n_points == pyvista.read(folder / "frames" / "tubes_003.vtp").n_points


def test_the_wall_is_as_far_from_the_path_as_its_radius(scanned, folder):
    pyvista = pytest.importorskip("pyvista")
    wall = pyvista.read(folder / "inscribed_tube.vtp")
    s = np.linspace(0.0, 130.0, 20001)
    away = np.linalg.norm(wall.points[::97, None, :] - path(s)[None], axis=-1).min(axis=1)
    assert np.abs(away - 6.0).max() < 0.02


def test_a_mirrored_scan_keeps_the_outside_of_surfaces_outside(scanned, tmp_path):
    """Images may be in left-anterior-superior coordinates, of which those of the robot are a mirror image."""
    pyvista = pytest.importorskip("pyvista")
    plan, _ = scanned
    told = {"problem": {**plan.meta["problem"], "space": "LAS"}}
    mirrored = replace(plan, meta=plan.meta | told, to_robot=np.eye(4))
    for name, whose in (("as it is", plan), ("mirrored", mirrored)):
        (tmp_path / f"{name}.vtp").write_text(slicer_files(whose)["frames/tubes_005.vtp"])
        mesh = pyvista.read(tmp_path / f"{name}.vtp")
        a, b, c = mesh.points[mesh.regular_faces].transpose(1, 0, 2)
        facing = (np.cross(b - a, c - a) * mesh.point_data["Normals"][mesh.regular_faces[:, 0]]).sum(axis=1)
        assert (facing > 0).mean() > 0.999


def test_a_plan_that_does_not_tell_its_coordinates_is_asked_for_them(scanned):
    plan, space = scanned
    told = {key: value for key, value in plan.meta["problem"].items() if key != "space"}
    older = replace(plan, meta=plan.meta | {"problem": told})
    with pytest.raises(OptionError, match="give --space LPS or --space RAS"):
        slicer_files(older)
    assert slicer_files(older, space) == slicer_files(plan)
    other = {"LPS": "RAS", "RAS": "LPS"}[space]
    with pytest.raises(OptionError, match=f"space is {other}, but the file of the plan's path, .* states {space}"):
        slicer_files(plan, other)


def test_a_plan_without_a_scan_is_written_in_its_own_frame(plan):
    pytest.importorskip("pyvista")
    (markup,) = json.loads(slicer_files(plan)["frames/robot_005.mrk.json"])["markups"]
    found = np.array([control["position"] for control in markup["controlPoints"]])
    assert np.abs(found - plan.shape[4]).max() < 1e-5


# glTF


def parts(content):
    """The JSON text of a binary glTF file and what its numbers are kept in."""
    magic, version, length, size, kind = struct.unpack_from("<4sII I4s", content)
    assert (magic, version, length, kind) == (b"glTF", 2, len(content), b"JSON")
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def in_robot(points):
    """Points of a scene, m, in the robot's base frame, mm."""
    x, y, z = 1e3 * np.asarray(points, dtype=float).T
    return np.column_stack([x, -z, y])


def numbers(scene, k):
    """The numbers (n, 1) or (n, 3) of an accessor, as pygltflib reads the scene."""
    accessor = scene.accessors[k]
    view, width = scene.bufferViews[accessor.bufferView], {"SCALAR": 1, "VEC3": 3}[accessor.type]
    held = np.frombuffer(scene.binary_blob(), "<f4", accessor.count * width, view.byteOffset)
    return held.reshape(accessor.count, width)


def test_the_scene_has_the_points_of_every_frame_in_metres_with_the_insertion_upwards(plan):
    pygltflib, trimesh = pytest.importorskip("pygltflib"), pytest.importorskip("trimesh")
    scene = pygltflib.GLTF2.load_from_bytes(encode_gltf(plan))
    lines = {mesh.name: mesh.primitives[0].attributes.POSITION for mesh in scene.meshes}
    drawn = trimesh.load(io.BytesIO(encode_gltf(plan)), file_type="glb").geometry
    for j in range(FRAMES):
        for name, points in ((f"centreline {j + 1}", plan.shape[j]), (f"target {j + 1}", plan.target[j])):
            for found in (numbers(scene, lines[name]), drawn[name].vertices):
                assert np.abs(in_robot(found) - points).max() < CLOSE


def test_the_tubes_of_the_scene_lie_around_the_robot(plan):
    trimesh = pytest.importorskip("trimesh")
    scene = trimesh.load(io.BytesIO(encode_gltf(plan)), file_type="glb").geometry
    for j in range(FRAMES):
        solids = [solid for name, solid in scene.items() if name.partition("_")[0] == f"tubes {j + 1}"]
        points = in_robot(np.vstack([solid.vertices for solid in solids]))
        away = np.linalg.norm(points[:, None] - plan.shape[j], axis=-1).min(axis=1)
        assert away.max() < np.hypot(max(tube.outer_diameter for tube in plan.robot.tubes), 1.0) / 2
        reached = (points @ plan.tip_direction[j]).max()
        assert reached == pytest.approx(plan.shape[j, -1] @ plan.tip_direction[j], abs=CLOSE)


def test_one_frame_is_shown_at_a_time_from_its_own_time_on(plan):
    pygltflib = pytest.importorskip("pygltflib")
    scene = pygltflib.GLTF2.load_from_bytes(encode_gltf(plan))
    (motion,) = scene.animations

    def shown(t):
        found = []
        for channel in motion.channels:
            sampler = motion.samplers[channel.sampler]
            assert (sampler.interpolation, channel.target.path) == ("STEP", "scale")
            times, scales = numbers(scene, sampler.input)[:, 0], numbers(scene, sampler.output)
            if (scales[max(0, np.searchsorted(times, t, side="right") - 1)] == 1.0).all():
                found.append(scene.nodes[channel.target.node].extras["frame"])
        return found

    for j in range(FRAMES):
        assert shown(plan.time[j] - plan.time[0] + 0.5 * plan.dt) == [j + 1]
    still = [n.extras["frame"] for n in scene.nodes if n.name.startswith("frame ") and n.scale != [0.0] * 3]
    assert still == [FRAMES]


def test_the_scene_keeps_to_the_rules_of_its_format(scanned):
    """What the specification asks of buffers, views and accessors, and bounds that are those of their numbers."""
    told, held = parts(encode_gltf(scanned[0]))
    assert "units" in told["asset"]["extras"]
    assert "+Y is up" in told["asset"]["extras"]["axes"]
    assert told["buffers"][0]["byteLength"] == len(held)
    kinds = {5126: "<f4", 5123: "<u2", 5125: "<u4"}
    arrays = []
    for accessor in told["accessors"]:
        view, width = told["bufferViews"][accessor["bufferView"]], {"SCALAR": 1, "VEC3": 3}[accessor["type"]]
        array = np.frombuffer(
            held, kinds[accessor["componentType"]], accessor["count"] * width, view["byteOffset"]
        )
        assert view["byteOffset"] % 4 == 0
        assert array.nbytes == view["byteLength"]
        arrays.append(array.reshape(-1, width))
        if "min" in accessor:
            assert accessor["min"] == arrays[-1].min(axis=0).tolist()
            assert accessor["max"] == arrays[-1].max(axis=0).tolist()
    for mesh in told["meshes"]:
        for primitive in mesh["primitives"]:
            points = arrays[primitive["attributes"]["POSITION"]]
            if primitive["mode"] == 4:
                normals, corners = arrays[primitive["attributes"]["NORMAL"]], arrays[primitive["indices"]]
                assert corners.max() == len(points) - 1
                assert np.abs(np.linalg.norm(normals, axis=1) - 1).max() < 1e-5
                a, b, c = points[corners.reshape(-1, 3)].transpose(1, 0, 2).astype(float)
                facing = (np.cross(b - a, c - a) * normals[corners.reshape(-1, 3)[:, 0]]).sum(axis=1)
                assert (facing > 0).mean() > 0.999  # of the wall a few fold where the path bends within its radius


# MATLAB


def test_matlab_reads_what_the_plan_holds(scanned):
    plan, space = scanned
    held = loadmat(io.BytesIO(encode_mat(plan)))
    for name in ("q", "shape", "target", "to_robot"):
        assert np.array_equal(held[name], getattr(plan, name))
    assert np.array_equal(held["time"][:, 0], plan.time)
    assert np.array_equal(held["e2"][:, 0], by_frame(plan)["e2"])
    assert held["e3"].item() == summary(plan)["e3"]
    assert held["unknowns"].shape == plan.q.shape
    assert [str(name[0]) for name in held["q_names"][:, 0]] == list(plan.robot.axes)
    assert [tube.item() for tube in held["robot"]["outer_diameter"].ravel()] == [
        tube.outer_diameter for tube in plan.robot.tubes
    ]
    assert held["space"].item() == space
    told = str(held["README"][0])
    assert all(f"{name}: " in told for name in held if not name.startswith("__") and name != "README")


# the table


def test_the_table_has_every_point_of_every_frame(plan):
    rows = list(csv.DictReader(io.StringIO(encode_shapes_csv(plan).decode())))
    columns = {name: np.array([float(row[name]) for row in rows]) for name in rows[0]}
    assert len(rows) == 101 * FRAMES
    for prefix, points in (("", plan.shape), ("target_", plan.target)):
        found = np.column_stack([columns[f"{prefix}{axis}_mm"] for axis in "xyz"])
        assert np.abs(found - points.reshape(-1, 3)).max() < 1e-6
    assert np.array_equal(columns["frame"], np.repeat(np.arange(1, FRAMES + 1), 101))
    assert columns["time_s"] == pytest.approx(np.repeat(plan.time, 101))
    assert columns["sigma"] == pytest.approx(np.tile(np.linspace(0, 1, 101), FRAMES))


# all of them


@pytest.mark.parametrize("of", [encode_gltf, encode_shapes_csv, slicer_files])
def test_frames_without_a_shape_are_left_out(plan, of):
    unreached = np.arange(FRAMES) != 3
    shape = np.where(unreached[:, None, None], np.nan, plan.shape)
    assert len(of(replace(plan, shape=shape))) < len(of(plan))
    with pytest.raises(OutputError, match="no frame of the plan has a shape"):
        of(replace(plan, shape=np.full_like(plan.shape, np.nan)))


def test_surfaces_turn_left_seen_from_outside(scanned):
    plan, _ = scanned
    for surface in (*tube_surfaces(plan, 4).values(), *wall_surfaces(plan).values()):
        a, b, c = surface.points[surface.triangles].transpose(1, 0, 2)
        across = np.cross(b - a, c - a)
        assert ((across * surface.normals[surface.triangles[:, 0]]).sum(axis=1) > 0).mean() > 0.999


# `ctr-nlp export`


def test_the_help_describes_every_format():
    text = load(COMMANDS["export"]).parser("ctr-nlp export").description
    assert [name for name in (*MACHINE_FORMATS, *EXCHANGE_FORMATS) if f" {name}," not in text] == []


@pytest.mark.parametrize("to", EXCHANGE_FORMATS)
def test_files_are_written_beside_the_plan_and_replaced(to, file, capsys):
    if to == "slicer":
        pytest.importorskip("pyvista")
    out = file.with_name("plan_slicer" if to == "slicer" else f"plan{FILE_FORMATS[to].suffix}")
    for _ in range(2):
        assert export(file, "--to", to) == 0
        assert str(out) in capsys.readouterr().out.replace("\n", "")
    assert out.exists()
    assert len(list(file.parent.iterdir())) == 2


@pytest.mark.parametrize("to", sorted(FILE_FORMATS))
def test_a_file_of_the_user_is_not_replaced(to, file, capsys):
    out = file.with_name(f"mine{FILE_FORMATS[to].suffix}")
    out.write_bytes(b"glTF and MATLAB 5.0 MAT-file and frame")
    assert export(file, "--to", to, "--out", out) == 2
    assert "was not written by ctr-nlp" in capsys.readouterr().err
    assert out.read_bytes() == b"glTF and MATLAB 5.0 MAT-file and frame"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("--to gltf --tempo 0.5", f"--tempo goes with commands of machines ({', '.join(MACHINE_FORMATS)})"),
        ("--to mat --hardware rig.toml", "--hardware goes with commands of machines"),
        ("--to slicer --storage mcap", "--storage goes with --to rosbag2; a slicer file has none"),
        ("--to mat --space LPS", "--space goes with --to slicer; a mat file is in the robot's base frame"),
        ("--to slicer --out x.vtp", "--out is x.vtp, but --to slicer writes a folder of files; name a folder"),
    ],
)
def test_options_that_make_no_sense_are_refused_in_one_line(arguments, told, file, capsys):
    assert export(file, *arguments.split()) == 2
    error = capsys.readouterr().err
    assert told in error
    assert error.count("\n") == 1
    assert list(file.parent.iterdir()) == [file]
