"""The scene in the browser: a tree of named objects, updated with the state, and handles to be dragged."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from ctr_nlp.exceptions import OptionError
from ctr_nlp.paths.lumen import Lumen, outermost_tube_radii, tube_outer_radii, wall_mesh
from ctr_nlp.paths.problem import Problem
from ctr_nlp.paths.target import SIGMA_GRID
from ctr_nlp.robot import Robot
from ctr_nlp.support.value_checks import floats
from ctr_nlp.typing import Array
from ctr_nlp.view.figures.parts.palette import BLACK, ORANGE, SKY, VERMILLION
from ctr_nlp.view.live.page.colours import MIDDLES, linear_light, piece_colours
from ctr_nlp.view.live.page.guard import log_unreadable
from ctr_nlp.view.live.steered.ghosts import GHOST_SHAPE_STRIDE
from ctr_nlp.view.live.steered.goal import HANDLES
from ctr_nlp.view.live.steered.session import MAX_SAMPLED_ROBOTS, SessionState
from ctr_nlp.view.report.camera import EYE_DISTANCE_AHEAD_MM, EYE_FIELD_OF_VIEW_DEG, upward_at_tip

HandleDragCallback = Callable[[int, Array], None]
"""Called with the number of a handle that is dragged, from 0, and the point (3,) mm to which it is pulled."""
TUBE_POLYGON_SIDES, LUMEN_POLYGON_SIDES, RING_MM = 12, 20, 3.0
"""Sides of a tube's cross-section, and of the lumen's; distance between rings of the lumen, mm."""
OVERLAP = 1.08
"""Length of a robot's piece over its share, so that no gaps open where the robot bends."""
LUMEN_SURFACE_COLOUR, LUMEN_OPACITY = (140, 140, 140), 0.22
KEEP_OUT_SURFACE_COLOUR = (204, 121, 167)
TARGET_MM, GHOST_MM, HANDLE_EXTRA_RADIUS_MM, TIP_HANDLE_EXTRA_RADIUS_MM = 0.6, 0.35, 0.8, 1.2
"""Widths of lines, and how much the radius of handles, and that of the tip, exceeds the innermost tube's."""
HANDLE_OPACITY = 0.35
"""Opacity of handles: tip and target are seen within them."""
HOLDER_MM = 12.0
"""Length of the part of the robot that is drawn before the insertion point, so that a retracted robot is seen."""
HOLDER_COLOUR = (119, 119, 119)
TIP_WALL_COLOUR = (231, 154, 140)
"""Colour of the wall as the tip sees it."""
TIP_LIGHT_INTENSITY, TIP_LIGHT_DECAY = 30.0, 1.0
"""Intensity of the light at the tip, in units of three.js, and the power of the distance by which it fades."""
SEEN_THROUGH = 0.5
"""Opacity of the robot beside simulated ones, which often lie within its tubes."""
AMBIENT_INTENSITY, LAMP_INTENSITY = 1.9, 1.3
"""Intensities of the lights outside. Together about pi, with which three.js shows a surface in its own colour, so
that the robot has the colours of the legend where it faces the lamp."""
TIP_SIGHT_MM = 10.0
"""Distance of the point that the tip's camera looks at, mm."""
AXES_MM = 12.0
"""Length of the base frame's axes."""
FORCE_MM, ARROW_MM, HEAD_MM = 0.8, 18.0, 3.0
"""Width and length of the arrow of a force at the tip, and length and width of its head."""
VIEW = (0.25, -1.0, 0.2)
"""Direction from which the scene is seen at first."""
LIVE_FIELD_OF_VIEW_DEG = 35.0
"""Field of view, degrees."""


class Scene:
    """Drawing of one problem in the browser: robot, simulated robots, target with handles, lumen and tip force."""

    def __init__(self, server: Any, problem: Problem, on_drag: HandleDragCallback) -> None:
        """Draw everything that never changes.

        server: of viser. problem: robot, target and lumen. on_drag: called in the server's own thread; it must
        return at once.
        """
        self._server = server
        self._robot = problem.robot
        scene = server.scene
        scene.configure_environment_map(None)
        scene.configure_default_lights(False)
        self._outside_lights = [
            scene.add_light_ambient("/light/all around", intensity=AMBIENT_INTENSITY),
            scene.add_light_directional(
                "/light/above", intensity=LAMP_INTENSITY, cast_shadow=False, position=(0.3, -1.0, 0.8)
            ),
        ]
        self._tip_light = scene.add_light_point(
            "/light/tip", intensity=TIP_LIGHT_INTENSITY, decay=TIP_LIGHT_DECAY, visible=False
        )
        self._from_tip = False
        scene.add_frame("/base", axes_length=AXES_MM, axes_radius=0.3)
        look = {"opacity": LUMEN_OPACITY, "cast_shadow": False, "receive_shadow": False}
        # Of a wall around the robot only the far side, so that it never covers the robot.
        around = {"color": LUMEN_SURFACE_COLOUR, "side": "back"} | look
        self._walls = list[Any]()
        if problem.lumen_wall is not None:
            vertices, triangles = wall_mesh(_coarse(problem.lumen_wall), LUMEN_POLYGON_SIDES)
            self._walls.append(scene.add_mesh_simple("/lumen", vertices.astype(np.float32), triangles, **around))
        kept_out = {"color": KEEP_OUT_SURFACE_COLOUR, "side": "front"} | look
        for k, wall in enumerate(problem.drawn_walls):
            drawn = wall.vertices.astype(np.float32), wall.triangles.astype(np.uint32)
            found = scene.add_mesh_simple(f"/wall {k + 1}", *drawn, **(kept_out if wall.keep_out else around))
            if not wall.keep_out:
                self._walls.append(found)
        place = np.zeros((len(MIDDLES), 3))
        self._body = scene.add_batched_meshes_simple(
            "/robot",
            *_rod(),
            np.tile([1.0, 0.0, 0.0, 0.0], (len(MIDDLES), 1)),
            place,
            batched_scales=place + 1.0,
            batched_colors=np.zeros((len(MIDDLES), 3), dtype=np.uint8),
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self._holder = scene.add_mesh_simple(
            "/holder", *_holder(self._robot), color=HOLDER_COLOUR, cast_shadow=False
        )
        black = np.array(to_rgb(BLACK))
        line = np.zeros((len(SIGMA_GRID) - 1, 2, 3))
        self._target = scene.add_line_segments("/target", line, black, thickness=TARGET_MM)
        parts = np.zeros((MAX_SAMPLED_ROBOTS * (len(SIGMA_GRID[::GHOST_SHAPE_STRIDE]) - 1), 2, 3))
        self._ghosts = scene.add_line_segments("/draws", parts, parts, thickness=GHOST_MM, visible=False)
        self._force = scene.add_line_segments(
            "/force", np.zeros((5, 2, 3)), np.array(to_rgb(VERMILLION)), thickness=FORCE_MM, visible=False
        )
        self._handles = [self._handle(k, on_drag) for k in range(HANDLES)]
        self._look(problem)

    def show(self, seen: SessionState, handles: Array, by: str) -> None:
        """Show a state `seen`; handles (HANDLES, 3): positions of the target's handles, mm; by: quantity that
        colours the robot.
        """
        self._show_robot(seen, by)
        self._target.points = _line_segments(seen.target)
        self._force.visible = bool(seen.force.any() and np.isfinite(seen.shape[-1]).all())
        if self._force.visible:
            self._force.points = _arrow(seen.shape[-1], seen.force / np.linalg.norm(seen.force))
        for handle, point in zip(self._handles, handles, strict=True):
            handle.position = point
        self._ghosts.visible = len(seen.ghosts) > 0
        self._body.opacity = SEEN_THROUGH if len(seen.ghosts) else 1.0
        if len(seen.ghosts):
            # Always as many lines; those of no robot lie at the insertion point.
            lines, colours = np.zeros(
                (2, MAX_SAMPLED_ROBOTS, len(SIGMA_GRID[::GHOST_SHAPE_STRIDE]) - 1, 2, 3), dtype=np.float32
            )
            for k, (shape, lost) in enumerate(zip(seen.ghosts, seen.lost, strict=True)):
                lines[k], colours[k] = np.nan_to_num(_line_segments(shape)), to_rgb(VERMILLION if lost else SKY)
            self._ghosts.points = lines.reshape(-1, 2, 3)
            self._ghosts.colors = colours.reshape(-1, 2, 3)

    def look_from_tip(self, on: bool, shape: Array) -> None:
        """Look along the tip of a shape (101, 3), mm, by its own light, where `on`; else from outside.

        Everyone who has the page open looks along it: the scene's objects are shared.
        """
        if on != self._from_tip:
            self._from_tip = on
            for wall in self._walls:
                _paint_wall(wall, on)
            for light in self._outside_lights:
                light.visible = not on
            self._tip_light.visible = on
            self._body.visible = not on
            if not on:
                self._return_cameras()
        if not on or not np.isfinite(shape[-2:]).all():
            return
        self._body.visible = False
        along = (shape[-1] - shape[-2]) / np.linalg.norm(shape[-1] - shape[-2])
        eye = shape[-1] + EYE_DISTANCE_AHEAD_MM * along
        self._tip_light.position = eye
        for client in self._server.get_clients().values():
            if client.camera.update_timestamp == 0.0:
                continue  # the page has not yet told its camera
            client.camera.up_direction = upward_at_tip(along)
            client.camera.position = eye
            client.camera.look_at = eye + TIP_SIGHT_MM * along
            client.camera.fov = np.radians(EYE_FIELD_OF_VIEW_DEG)

    def _return_cameras(self) -> None:
        """Take the cameras of all open pages back to where the scene is first seen from."""
        first = self._server.initial_camera
        for client in self._server.get_clients().values():
            client.camera.up_direction = first.up
            client.camera.position = first.position
            client.camera.look_at = first.look_at
            client.camera.fov = first.fov

    def _show_robot(self, seen: SessionState, by: str) -> None:
        """Place, turn and colour the pieces of the robot; hide it where it has no shape."""
        # Lower-case axes are fixed ones in scipy, so that this is R = Ry(theta_y) Rx(theta_x), eq. (4).
        tilt = Rotation.from_euler("xy", self._robot.split(seen.q)[2])
        self._holder.wxyz = np.roll(tilt.as_quat(), 1)
        known = bool(np.isfinite(seen.shape).all())
        self._body.visible = known
        if known:
            ahead = np.diff(seen.shape, axis=0)
            length = np.linalg.norm(ahead, axis=1)
            beta = self._robot.split(seen.q)[1]
            radius = outermost_tube_radii(self._robot, beta[None], MIDDLES)[0]
            self._body.batched_positions = ((seen.shape[1:] + seen.shape[:-1]) / 2).astype(np.float32)
            self._body.batched_wxyzs = _quaternions_towards(ahead / np.maximum(length, 1e-9)[:, None]).astype(
                np.float32
            )
            self._body.batched_scales = np.stack([radius, radius, OVERLAP * length], axis=1).astype(np.float32)
            self._body.batched_colors = linear_light(piece_colours(self._robot, seen, by))

    def _handle(self, k: int, on_drag: HandleDragCallback) -> Any:
        """Add the ball of handle k, from 0, that can be dragged; the last one is the target's tip."""
        tip = k == HANDLES - 1
        name, colour = ("/tip", VERMILLION) if tip else (f"/handle {k + 1}", ORANGE)
        radius = float(tube_outer_radii(self._robot)[-1]) + (
            TIP_HANDLE_EXTRA_RADIUS_MM if tip else HANDLE_EXTRA_RADIUS_MM
        )
        look = {
            "opacity": HANDLE_OPACITY,
            "color": to_rgb(colour),
            "subdivisions": 2,
            "cast_shadow": False,
            "receive_shadow": False,
        }
        ball = self._server.scene.add_icosphere(name, radius, **look)
        grabbed = np.zeros(3)

        @ball.on_drag
        async def _(event: Any) -> None:
            try:
                start = floats(OptionError, "start_position", event.start_position, (3,))
                end = floats(OptionError, "end_position", event.end_position, (3,))
            except OptionError as error:
                log_unreadable(error)
                return
            # A ball is rarely grabbed at its centre; without this offset it would jump to the pointer.
            if event.phase == "start":
                grabbed[:] = start - ball.position
            on_drag(k, end - grabbed)

        return ball

    def _look(self, problem: Problem) -> None:
        """Place the first view so that the robot's holder and all of the path are seen from the side."""
        points = np.concatenate([problem.target_frames[-1].points, [[0.0, 0.0, -HOLDER_MM]]])
        low = points.min(axis=0)
        high = points.max(axis=0)
        middle = (low + high) / 2
        away = np.array(VIEW)
        if high[1] - low[1] > high[0] - low[0]:
            away = away[[1, 0, 2]] * [-1.0, 1.0, 1.0]
        far = 0.6 * np.linalg.norm(high - low) / np.tan(np.radians(LIVE_FIELD_OF_VIEW_DEG / 2))
        camera = self._server.initial_camera
        camera.up = (0.0, 0.0, 1.0)
        camera.fov = float(np.radians(LIVE_FIELD_OF_VIEW_DEG))
        camera.look_at = tuple(middle)
        camera.position = tuple(middle + far * away / np.linalg.norm(away))


def _paint_wall(mesh: Any, inside: bool) -> None:
    """Show a wall as it is seen from within, solid and pink, or from outside, translucent."""
    mesh.color = TIP_WALL_COLOUR if inside else LUMEN_SURFACE_COLOUR
    mesh.opacity = 1.0 if inside else LUMEN_OPACITY
    mesh.side = "double" if inside else "back"


def _arrow(begin: Array, direction: Array) -> Array:
    """Return five lines (5, 2, 3), mm, of an arrow that begins at a point (3,) and has a direction, a unit vector
    (3,).
    """
    end = begin + ARROW_MM * direction
    across = np.eye(3)[abs(direction).argmin()]
    side = np.cross(direction, across) / np.linalg.norm(np.cross(direction, across))
    sides = [side, -side, np.cross(direction, side), -np.cross(direction, side)]
    heads = [(end, end - HEAD_MM * direction + HEAD_MM / 2 * each) for each in sides]
    return np.array([(begin, end), *heads], dtype=np.float32)


def _line_segments(points: Array) -> Array:
    """Return the lines (n - 1, 2, 3) between neighbours of points (n, 3)."""
    return np.stack([points[:-1], points[1:]], axis=1).astype(np.float32)


def _coarse(lumen: Lumen) -> Array:
    """Return a lumen's table (N, 4) at its ends and few rings between: triangles are drawn thirty times a
    second.
    """
    count = max(2, round(lumen.arc_lengths[-1] / RING_MM) + 1)
    chosen = np.searchsorted(lumen.arc_lengths, np.linspace(0.0, lumen.arc_lengths[-1], count))
    return np.asarray(lumen.table[np.unique(chosen)])


def _rod() -> tuple[Array, Array]:
    """Return vertices and triangles of a closed rod along z, of radius and length 1, around the origin."""
    angle = np.linspace(0.0, 2 * np.pi, TUBE_POLYGON_SIDES, endpoint=False)
    ring = np.stack([np.cos(angle), np.sin(angle), np.zeros(TUBE_POLYGON_SIDES)], axis=1)
    ends = [ring + np.array([0.0, 0.0, side]) for side in (-0.5, 0.5)]
    vertices = np.concatenate(
        [*ends, *ends, [[0.0, 0.0, -0.5], [0.0, 0.0, 0.5]]]
    )  # ends of their own: sharp edges
    k = np.arange(TUBE_POLYGON_SIDES)
    beside = (k + 1) % TUBE_POLYGON_SIDES
    sides = [[k, beside, k + TUBE_POLYGON_SIDES], [beside, beside + TUBE_POLYGON_SIDES, k + TUBE_POLYGON_SIDES]]
    below = 2 * TUBE_POLYGON_SIDES
    above = 3 * TUBE_POLYGON_SIDES
    caps = [
        [beside + below, k + below, np.full(TUBE_POLYGON_SIDES, 4 * TUBE_POLYGON_SIDES)],
        [k + above, beside + above, np.full(TUBE_POLYGON_SIDES, 4 * TUBE_POLYGON_SIDES + 1)],
    ]
    return vertices, np.concatenate([np.transpose(each) for each in (*sides, *caps)])


def _holder(robot: Robot) -> tuple[Array, Array]:
    """Return vertices (n, 3), mm, and triangles of the robot's holder, which ends at the insertion point."""
    vertices, triangles = _rod()
    radius = 1.5 * float(tube_outer_radii(robot)[0])
    return vertices * [radius, radius, HOLDER_MM] - [0.0, 0.0, HOLDER_MM / 2], triangles


def _quaternions_towards(ahead: Array) -> Array:
    """Return quaternions (n, 4) wxyz that turn z to unit vectors `ahead` (n, 3) by the smallest rotation."""
    # (1 + z . a, z x a) is twice the cosine of the half angle times the quaternion. It vanishes for a = -z, where
    # a half turn about x is taken.
    found = np.stack([1.0 + ahead[:, 2], -ahead[:, 1], ahead[:, 0], 0.0 * ahead[:, 2]], axis=1)
    found[found[:, 0] < 1e-9] = [0.0, 1.0, 0.0, 0.0]
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True))
