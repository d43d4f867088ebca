"""A plan as an animated scene in three dimensions, and the quantities that colour its robot."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib import colormaps
from matplotlib.colors import to_hex, to_rgb
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import escape_control_characters
from ctr_nlp.paths.lumen import tube_outer_radii, wall_mesh, wall_rings
from ctr_nlp.paths.points import cumulative_arc_length
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.paths.wall_surfaces import wall_sections
from ctr_nlp.plan.metrics import e1
from ctr_nlp.plan.plan import Plan
from ctr_nlp.support.extras import import_extra
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.overlay import tube_ends
from ctr_nlp.view.figures.parts.palette import BLACK, CONTACT, ERROR_COLOUR_MAP, KEEP_OUT_COLOUR, tube_colour
from ctr_nlp.view.figures.parts.space import points_of_all
from ctr_nlp.view.figures.parts.wall_forces import WALL_FORCE_COLOUR, wall_force_lines
from ctr_nlp.view.report.camera import OUTSIDE_FIELD_OF_VIEW_DEG, cameras
from ctr_nlp.view.report.ghosts import ghosts
from ctr_nlp.view.report.places import arrival_tolerance

SHADES = np.linspace(0.0, 1.0, 17)
SCALE_FRACTION_BELOW_ZERO = 1 / 8
"""Length of a scale below 0 as a part of its length above 0."""
MIN_COLOUR_SCALE_SPAN = 0.1
"""Least span of a scale: less is rounding noise."""


@dataclass(frozen=True)
class ColourScale:
    """Colour scale of a quantity along the robot: its key, its name with unit, and the values at both ends.

    stops: (position in [0, 1], colour), in order; two at one position are a jump.
    """

    key: str
    name: str
    low: float
    high: float
    stops: tuple[tuple[float, str], ...]


def quantities(plan: Plan) -> dict[str, Array]:
    """Return values (T, 101) at uniform sigma of what is known of a plan: error and clearance in mm, stability
    margin.
    """
    found = {"error": e1(plan), "stability": np.repeat(plan.stability[:, None], len(SIGMA_GRID), axis=1)}
    if plan.clearance is not None:
        found["clearance"] = plan.clearance
    return {key: values for key, values in found.items() if np.isfinite(values).any()}


def scales(plans: Sequence[Plan]) -> list[ColourScale]:
    """Return a colour scale for each quantity that is known of any of `plans`; all plans share it."""
    known = [quantities(plan) for plan in plans]
    most = {
        key: max(MIN_COLOUR_SCALE_SPAN, *(float(np.nanmax(some[key])) for some in known if key in some))
        for key in dict.fromkeys(key for some in known for key in some)
    }
    errors = tuple(zip(SHADES.tolist(), _colours(SHADES), strict=True))
    every = [
        ColourScale("error", "error at equal arc length (mm)", 0.0, most.get("error", 0.0), errors),
        _signed_scale("clearance", "clearance from the wall (mm), contact below 0", most.get("clearance", 0.0)),
        _signed_scale("stability", "stability margin, unstable below 0", 1.0),
    ]
    return [scale for scale in every if scale.key in most]


def _signed_scale(key: str, name: str, high: float) -> ColourScale:
    """Return a scale with the colour of contact below 0; above, the colours of errors reversed, with more shades
    near 0.
    """
    zero = SCALE_FRACTION_BELOW_ZERO / (1 + SCALE_FRACTION_BELOW_ZERO)
    roomy = zip(zero + (1 - zero) * SHADES, _colours(1.0 - np.sqrt(SHADES)), strict=True)
    stops = ((0.0, CONTACT), (zero, CONTACT), *((float(at), colour) for at, colour in roomy))
    return ColourScale(key, name, -SCALE_FRACTION_BELOW_ZERO * high, high, stops)


def _colours(bad: Array) -> list[str]:
    """Return colours for numbers (n,) from 0, good and dark, to 1, bad and light."""
    return [to_hex(colour) for colour in colormaps[ERROR_COLOUR_MAP](bad)]


TUBE_COLOURING = "tube"
"""Colouring that every plan has: each tube in its own colour."""
SCENE_TUBE_POINTS = 31
"""Number of points along a tube's visible part."""
SCENE_WALL_RING_POINTS, SCENE_WALL_RING_SPACING_MM = 24, 10.0
"""Points around the wall, and mm between its rings."""
HOLDER_LENGTH_MM = 12.0
"""Length of the part of the robot that is drawn before the insertion point."""
TARGET_RADIUS, AXIS_RADIUS, POINT_SIZE = 0.25, 0.12, 2.6
"""Radii of the target's line and the insertion axis, mm; diameter of the insertion point in radii of tube 1."""
SCENE_WALL_COLOUR, SCENE_WALL_OPACITY = 0x8A8A8A, 0.2
SCENE_HOLDER_COLOUR, SCENE_AXIS_COLOUR = 0x777777, 0x888888
SCENE_ROBOT_PART, SCENE_WALL_PART, SCENE_TARGET_PART = "robot", "wall", "target"
"""Parts of a scene that are switched on and off, in the custom_data of its objects."""
SCENE_TARGET_END_PART, SCENE_TARGET_END_COLOUR = "target's end", "#6A00A8"
"""The marker at the target's end: its part, and a violet that stands out from tubes, white and a pink wall."""
SCENE_FORCES_PART, FORCE_LINE_WIDTH_MM = "wall's forces", 0.4
"""Lines of the wall's forces on the robot: their part, and their width, mm."""
TARGET_END_LINE_MM, TARGET_END_OPACITY = 0.3, 0.25
"""Width of the cross at the target's end, mm, and opacity of the sphere around it."""
SCENE_DATA_PLACEHOLDER = "@DATA@"
"""Stands in k3d's page for the data."""
READY = (
    "console.log = () => {}; document.documentElement.lang = 'en'; document.title = 'Scene'; "
    "window.parent.ready(window.frameElement, K3DInstance);"
)
"""Script that runs in each scene once it is drawn; k3d would log a line for every tube of every frame."""


def scene_template() -> str:
    """Return k3d's page for any scene, with SCENE_DATA_PLACEHOLDER in place of its data."""
    empty = import_extra("k3d").plot()
    # k3d's page contains its whole library. The report has it once; of each plan it has the data alone.
    data = base64.b64encode(empty.get_binary_snapshot()).decode()
    return str(empty.get_snapshot(additional_js_code=READY)).replace(data, SCENE_DATA_PLACEHOLDER)


def scene(plan: Plan, scales: Sequence[ColourScale], corners: tuple[Array, Array], axes: Array) -> str:
    """Return the data of a plan's scene in base64.

    plan: the plan. scales: colour scales that the robot can be coloured by. corners: lowest and highest (3,), mm,
    of the box that is seen at first. axes: rotation (3, 3) of picture_axes. The scene's time is the index of the
    frame. Objects name their part in their custom_data, and their colouring where they show under one only.
    """
    low, high = corners
    k3d = import_extra("k3d")
    plot = k3d.plot(
        menu_visibility=False,
        camera_auto_fit=False,
        grid_auto_fit=False,
        grid=[*low, *high],
        grid_visible=False,
        axes_helper=0.0,
        camera_fov=OUTSIDE_FIELD_OF_VIEW_DEG,
        colorbar_object_id=0,
    )
    plot.camera = cameras(low, high, axes)["side"]
    for drawn in [*_tubes(k3d, plan, scales), *_environment_objects(k3d, plan), *ghosts(k3d, plan)]:
        plot += drawn
    return base64.b64encode(plot.get_binary_snapshot()).decode()


def _tubes(k3d: Any, plan: Plan, scales: Sequence[ColourScale]) -> list[Any]:
    """Return each tube where it is the outermost one, once for every colouring."""
    known = quantities(plan)
    radius = tube_outer_radii(plan.robot)
    found = []
    sigma = _visible(plan)
    for i in range(plan.robot.d):
        vertices = _over_time(_at(sigma[:, i], plan.shape))
        tube = partial(k3d.line, vertices, width=float(radius[i]), shader="mesh", radial_segments=16)
        named = {"name": f"tube {i + 1}", "custom_data": {"part": SCENE_ROBOT_PART, "colouring": TUBE_COLOURING}}
        found.append(tube(color=_pack_colour(tube_colour(i)), **named))
        for scale in (scale for scale in scales if scale.key in known):
            values = np.clip(np.nan_to_num(known[scale.key], nan=scale.low), scale.low, scale.high)
            coloured = {
                "attribute": _over_time(_at(sigma[:, i], values[..., None])[..., 0]),
                "color_map": [part for at, colour in scale.stops for part in (at, *to_rgb(colour))],
                "color_range": [scale.low, scale.high],
            }
            told = {"part": SCENE_ROBOT_PART, "colouring": scale.key}
            found.append(tube(visible=False, name=f"tube {i + 1} by {scale.key}", custom_data=told, **coloured))
    return found


def _environment_objects(k3d: Any, plan: Plan) -> list[Any]:
    """Return target, insertion point and axis, the robot's holder with its tilt, and the wall where it is
    known.
    """
    # Lower-case axes are fixed ones in scipy, so that this is R = Ry(theta_y) Rx(theta_x), eq. (4).
    tilted = Rotation.from_euler("xy", np.nan_to_num(plan.theta)).apply([0.0, 0.0, -HOLDER_LENGTH_MM])
    radius = float(tube_outer_radii(plan.robot)[0])
    line = partial(k3d.line, shader="mesh")
    black = _pack_colour(BLACK)
    axis = [[0.0, 0.0, -1.5 * HOLDER_LENGTH_MM], [0.0, 0.0, HOLDER_LENGTH_MM]]
    holder = np.stack([tilted, 0 * tilted], axis=1)
    held = {"name": "holder, tilted", "custom_data": {"part": SCENE_ROBOT_PART}}
    aim = {"name": "target", "custom_data": {"part": SCENE_TARGET_PART}}
    found = [
        line(_over_time(plan.target), color=black, width=TARGET_RADIUS, **aim),
        k3d.points([[0.0, 0.0, 0.0]], point_size=POINT_SIZE * radius, color=black, name="insertion point"),
        line(axis, color=SCENE_AXIS_COLOUR, width=AXIS_RADIUS, name="insertion axis"),
        line(_over_time(holder), color=SCENE_HOLDER_COLOUR, width=1.5 * radius, **held),
    ]
    return found + _target_end_objects(k3d, plan) + _wall_objects(k3d, plan) + _force_objects(k3d, plan)


def _target_end_objects(k3d: Any, plan: Plan) -> list[Any]:
    """Return the marker at the target's last end: a sphere in which the tip has arrived, and a cross in it."""
    radius = arrival_tolerance(plan)
    end = plan.target[-1, -1]
    look = {"color": _pack_colour(SCENE_TARGET_END_COLOUR), "custom_data": {"part": SCENE_TARGET_END_PART}}
    arms = np.concatenate([end + radius * np.eye(3), end - radius * np.eye(3)]).astype(np.float32)
    pairs = np.array([[0, 3], [1, 4], [2, 5]], dtype=np.uint32)
    return [
        k3d.points(
            end[None].astype(np.float32),
            point_size=2 * radius,
            shader="mesh",
            mesh_detail=3,
            opacity=TARGET_END_OPACITY,
            name=SCENE_TARGET_END_PART,
            **look,
        ),
        k3d.lines(
            arms, pairs, indices_type="segment", width=TARGET_END_LINE_MM, shader="mesh", name="cross", **look
        ),
    ]


def _wall_objects(k3d: Any, plan: Plan) -> list[Any]:
    """Return the walls: the tube around the path with rings, or the surfaces of bodies with their sections."""
    look = {"opacity": SCENE_WALL_OPACITY, "flat_shading": False, "side": "double"}
    part = {"custom_data": {"part": SCENE_WALL_PART}}
    rings = {"indices_type": "segment", "width": AXIS_RADIUS, "shader": "thick"}
    found = []
    if plan.lumen_wall is not None:
        vertices, triangles = wall_mesh(plan.lumen_wall, SCENE_WALL_RING_POINTS)
        colour = {"color": SCENE_WALL_COLOUR} | part
        found.append(k3d.mesh(vertices.astype(np.float32), triangles, name="lumen", **colour, **look))
        found.append(k3d.lines(*_hoops(plan.lumen_wall), name="lumen, rings", **colour, **rings))
    for wall in plan.drawn_walls:
        colour = {"color": _pack_colour(KEEP_OUT_COLOUR) if wall.keep_out else SCENE_WALL_COLOUR} | part
        name = escape_control_characters(wall.name)
        vertices, triangles = wall.vertices.astype(np.float32), wall.triangles.astype(np.uint32)
        found.append(k3d.mesh(vertices, triangles, name=name, **colour, **look))
        pieces = wall_sections(wall, plan.target[-1], SCENE_WALL_RING_SPACING_MM)
        if len(pieces) and not wall.keep_out:
            pairs = np.arange(2 * len(pieces), dtype=np.uint32).reshape(-1, 2)
            points = pieces.reshape(-1, 3).astype(np.float32)
            found.append(k3d.lines(points, pairs, name=f"{name}, rings", **colour, **rings))
    return found


def _force_objects(k3d: Any, plan: Plan) -> list[Any]:
    """Return the lines of the wall's forces on the robot, in one object; an empty list where it leans on none."""
    if plan.wall_force is None:
        return []
    # A frame without a shape has its lines at the insertion point, without length.
    lines = np.nan_to_num(wall_force_lines(plan)).reshape(len(plan.time), -1, 3)
    pairs = np.arange(lines.shape[1], dtype=np.uint32).reshape(-1, 2)
    look = {"indices_type": "segment", "width": FORCE_LINE_WIDTH_MM, "shader": "thick"}
    named = {"name": SCENE_FORCES_PART, "custom_data": {"part": SCENE_FORCES_PART}}
    return [k3d.lines(_over_time(lines), pairs, color=_pack_colour(WALL_FORCE_COLOUR), **look, **named)]


def _hoops(lumen: Array) -> tuple[Array, npt.NDArray[np.uint32]]:
    """Return rings of the wall every SCENE_WALL_RING_SPACING_MM, which show its depth from within: points and
    pairs of them.
    """
    along = cumulative_arc_length(lumen[:, :3])
    stations = np.unique(np.searchsorted(along, np.arange(0.0, along[-1], SCENE_WALL_RING_SPACING_MM)))
    hoops = wall_rings(lumen, np.linspace(0.0, 2 * np.pi, SCENE_WALL_RING_POINTS, endpoint=False))[stations]
    here = np.arange(hoops[..., 0].size).reshape(-1, SCENE_WALL_RING_POINTS)
    pairs = np.stack([here, np.roll(here, -1, axis=1)], axis=-1)
    return hoops.reshape(-1, 3).astype(np.float32), pairs.reshape(-1, 2).astype(np.uint32)


def _visible(plan: Plan) -> Array:
    """Return sigma (T, d, SCENE_TUBE_POINTS) along the part of each tube where it is the outermost one."""
    ends = np.array([tube_ends(beta) for beta in np.nan_to_num(plan.beta)])
    starts = np.concatenate([np.zeros((len(ends), 1)), ends[:, :-1]], axis=1)
    return starts[..., None] + (ends - starts)[..., None] * np.linspace(0.0, 1.0, SCENE_TUBE_POINTS)


def _at(sigma: Array, values: Array) -> Array:
    """Interpolate values (T, 101, n) at sigma (T, m), giving (T, m, n); 0 in frames that were never reached."""
    place = np.clip(sigma, 0.0, 1.0) * (len(SIGMA_GRID) - 1)
    before = np.minimum(place.astype(int), len(SIGMA_GRID) - 2)
    frames = np.arange(len(values))[:, None]
    part = (place - before)[..., None]
    return np.nan_to_num((1 - part) * values[frames, before] + part * values[frames, before + 1])


def _over_time(frames: Any) -> dict[str, npt.NDArray[np.float32]]:
    """Return a keyframe for each frame."""
    return {str(j): np.asarray(frame, dtype=np.float32) for j, frame in enumerate(frames)}


def box(plans: Sequence[Plan]) -> tuple[Array, Array]:
    """Return the corners (3,), mm, of a box around everything that `plans` ever show."""
    seen = [points_of_all([plan.target, plan.shape], plan.lumen_wall) for plan in plans]
    seen += [wall.vertices for plan in plans for wall in plan.drawn_walls if not wall.keep_out]
    points = np.concatenate([[[0.0, 0.0, -HOLDER_LENGTH_MM], [0.0, 0.0, HOLDER_LENGTH_MM]], *seen])
    return np.nanmin(points, axis=0), np.nanmax(points, axis=0)


def _pack_colour(colour: str) -> int:
    """Return a colour as k3d takes it, 0xRRGGBB."""
    red, green, blue = (round(255 * part) for part in to_rgb(colour))
    return red << 16 | green << 8 | blue
