"""Write a plan as an animated glTF 2.0 scene in one binary file, .glb (Khronos, glTF 2.0 Specification, 2021).

Frames are nodes, of which one at a time has the scale 1 and all others 0. This flip-book needs only core glTF.
Morph targets would not do: viewers need not support more than eight, and tubes that come out change their number
of points.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ctr_nlp.exceptions import escape_control_characters
from ctr_nlp.plan.plan import Plan
from ctr_nlp.typing import Array
from ctr_nlp.view.exchange.plan_surfaces import (
    INSCRIBED_TUBE_NAME,
    ShadedSurface,
    frames_with_shape,
    tube_surfaces,
    wall_surfaces,
)
from ctr_nlp.view.figures.parts.palette import BLACK, KEEP_OUT_COLOUR, WALL_GLASS_COLOUR, tube_colour

# A rotation by -90 degrees about x, (x, y, z) -> (x, z, -y). Its determinant is +1, so that triangles keep their
# outside, and normals turn as points do.
BASE_TO_GLTF_AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""From the robot's base frame to glTF's, in which +Y is up: the insertion direction, +z, leads upwards."""
GLTF_M_PER_MM = 1e-3
"""Metres per millimetre: glTF is in metres."""
GLTF_METADATA = {
    "units": "metres",
    "axes": "+Y is up: the robot's insertion direction, +z of its base frame; +X is its x, +Z its -y; the origin "
    "is the insertion point",
    "time": "seconds; every frame of the plan is shown from its own time on, the first of them at 0",
}
ASSET = '{"asset":{"version":"2.0","generator":"ctr_nlp"'
"""Beginning of the JSON text within the file, by which a file of ours is recognised."""
GLTF_SIGNATURE, GLTF_SIGNATURE_OFFSET = ASSET, 20
"""Signature of a file, and its first byte: after the file's header (12 bytes) and the first chunk's (8)."""
GLTF_FLOAT, GLTF_UNSIGNED_SHORT, GLTF_UNSIGNED_INT = 5126, 5123, 5125
"""glTF's codes of component types; below, of what a buffer view contains and of how points are joined."""
VERTICES, INDICES = 34962, 34963
GLTF_LINES, GLTF_TRIANGLES = 1, 4


def encode_gltf(plan: Plan) -> bytes:
    """Return the bytes of a plan's scene: tubes, centreline and target of every frame with a shape, and the
    lumen's wall.

    plan: the plan, whose shapes (101, 3) mm in the robot's base frame become metres with the insertion direction
    upwards. The animation runs at the pace of the motion; without it, the last frame is shown. Raises OutputError
    where no frame has a shape.
    """
    scene = _Scene()
    frames = frames_with_shape(plan)
    tubes = [scene.material(f"tube {i + 1}", tube_colour(i)) for i in range(plan.robot.d)]
    centreline = scene.material("centreline", tube_colour(plan.robot.d))
    target = scene.material("target", BLACK)
    roots = []
    for j in frames:
        surfaces = {tubes[i - 1]: surface for i, surface in tube_surfaces(plan, j).items()}
        parts = [scene.node(f"tubes {j + 1}", scene.solid(surfaces))] if surfaces else []
        parts.append(scene.node(f"centreline {j + 1}", scene.line(plan.shape[j], centreline)))
        parts.append(scene.node(f"target {j + 1}", scene.line(plan.target[j], target)))
        shown = {"scale": [0.0, 0.0, 0.0]} if j != frames[-1] else {}
        told = {"extras": {"frame": j + 1, "time_s": float(plan.time[j])}}
        roots.append(scene.add("nodes", {"name": f"frame {j + 1}", "children": parts} | shown | told))
    kept_out = {body.name for body in plan.walls if body.keep_out}
    for name, wall in wall_surfaces(plan).items():
        label = "wall" if name == INSCRIBED_TUBE_NAME else escape_control_characters(name)
        glass = scene.material(label, KEEP_OUT_COLOUR if name in kept_out else WALL_GLASS_COLOUR, 0.25)
        roots.append(scene.node(label, scene.solid({glass: wall})))
    if len(frames) > 1:
        scene.animate(roots[: len(frames)], plan.time[frames] - plan.time[frames[0]], plan.dt)
    return scene.file(escape_control_characters(plan.meta["problem"]["name"]), roots)


@dataclass
class _Scene:
    """Parts of a scene as they are added: lists of JSON objects by kind, and the bytes that they refer to."""

    parts: dict[str, list[dict[str, Any]]] = field(default_factory=dict)
    binary: bytearray = field(default_factory=bytearray)

    def add(self, kind: str, part: dict[str, Any]) -> int:
        """Add a part to the list of its kind, and return its number there."""
        listed = self.parts.setdefault(kind, [])
        listed.append(part)
        return len(listed) - 1

    def material(self, name: str, colour: str, opacity: float = 1.0) -> int:
        """Add a matt material of a colour such as #0072B2, with an opacity from 0 to 1, and return its number."""
        shade = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
        # glTF takes base colours in linear light: the inverse of the sRGB transfer function (IEC 61966-2-1).
        linear = np.where(shade <= 0.04045, shade / 12.92, ((shade + 0.055) / 1.055) ** 2.4)
        surface = {"baseColorFactor": [*linear.tolist(), opacity], "metallicFactor": 0.0, "roughnessFactor": 0.6}
        glass = {"alphaMode": "BLEND", "doubleSided": True} if opacity < 1.0 else {}
        return self.add("materials", {"name": name, "pbrMetallicRoughness": surface} | glass)

    def node(self, name: str, primitives: list[dict[str, Any]]) -> int:
        """Add a node with a mesh of its own, both called `name`, and return its number."""
        return self.add(
            "nodes", {"name": name, "mesh": self.add("meshes", {"name": name, "primitives": primitives})}
        )

    def solid(self, surfaces: dict[int, ShadedSurface]) -> list[dict[str, Any]]:
        """Return the primitives of surfaces in the robot's base frame, mm; their keys are the numbers of their
        materials.
        """
        found = []
        for material, surface in surfaces.items():
            attributes = {
                "POSITION": self.numbers(
                    surface.points @ BASE_TO_GLTF_AXES.T * GLTF_M_PER_MM, "VEC3", VERTICES, bounds=True
                ),
                "NORMAL": self.numbers(surface.normals @ BASE_TO_GLTF_AXES.T, "VEC3", VERTICES),
            }
            corners = self.numbers(surface.triangles.reshape(-1), "SCALAR", INDICES)
            found.append(
                {"attributes": attributes, "indices": corners, "material": material, "mode": GLTF_TRIANGLES}
            )
        return found

    def line(self, points: Array, material: int) -> list[dict[str, Any]]:
        """Return the primitives of a line through points (n, 3), mm in the robot's base frame; material: its
        number.
        """
        places = {
            "POSITION": self.numbers(points @ BASE_TO_GLTF_AXES.T * GLTF_M_PER_MM, "VEC3", VERTICES, bounds=True)
        }
        ends = self.numbers(np.repeat(np.arange(len(points)), 2)[1:-1], "SCALAR", INDICES)
        return [{"attributes": places, "indices": ends, "material": material, "mode": GLTF_LINES}]

    def numbers(self, values: Any, kind: str, target: int | None = None, bounds: bool = False) -> int:
        """Store an array, and return the number of its accessor.

        values: array, stored as single floats, or as whole numbers where they are indices. kind: glTF's name of an
        element, such as "VEC3". target: VERTICES, INDICES or None. bounds: whether the accessor has the least and
        largest values.
        """
        whole = target == INDICES
        # glTF reserves the largest number of a type.
        short = whole and values.max() < 2**16 - 1
        array = values.astype("<u2" if short else "<u4" if whole else "<f4")
        view = {"buffer": 0, "byteOffset": len(self.binary), "byteLength": array.nbytes}
        # An accessor begins at a multiple of its component's size; 4 bytes suit every type here.
        self.binary += array.tobytes() + bytes(-array.nbytes % 4)
        accessor = {
            "bufferView": self.add("bufferViews", view | ({} if target is None else {"target": target})),
            "componentType": GLTF_UNSIGNED_SHORT if short else GLTF_UNSIGNED_INT if whole else GLTF_FLOAT,
            "count": len(array),
            "type": kind,
        }
        # The specification requires these bounds of positions and of the times of an animation.
        ends = {"min": array.min(axis=0), "max": array.max(axis=0)} if bounds else {}
        return self.add(
            "accessors", accessor | {end: np.atleast_1d(value).tolist() for end, value in ends.items()}
        )

    def animate(self, nodes: list[int], times: Array, last: float) -> None:
        """Show one of `nodes` after the other, each from its time in `times` (n,) s on, and the last one for
        `last` s.
        """
        samplers = list[dict[str, Any]]()
        channels = []
        ends = np.append(times[1:], times[-1] + last)
        # Core glTF has no switch for visibility: a hidden node has the scale 0.
        for k, node in enumerate(nodes):
            keys = [(0.0, k == 0), *([(times[k], True)] if k else []), (ends[k], k == len(nodes) - 1)]
            at = self.numbers(np.array([[time] for time, _ in keys]), "SCALAR", bounds=True)
            scale = self.numbers(np.array([[float(shown)] * 3 for _, shown in keys]), "VEC3")
            channels.append({"sampler": len(samplers), "target": {"node": node, "path": "scale"}})
            samplers.append({"input": at, "output": scale, "interpolation": "STEP"})
        self.add("animations", {"name": "motion", "samplers": samplers, "channels": channels})

    def file(self, name: str, roots: list[int]) -> bytes:
        """Return the binary file of a scene called `name`, with the nodes `roots` at its top."""
        asset = {"version": "2.0", "generator": "ctr_nlp", "extras": GLTF_METADATA}
        # The asset goes first, where GLTF_SIGNATURE is looked for.
        told = {"asset": asset, "scene": 0, "scenes": [{"name": name, "nodes": roots}]}
        told |= self.parts | {"buffers": [{"byteLength": len(self.binary)}]}
        text = json.dumps(told, allow_nan=False, separators=(",", ":")).encode()
        chunks = b""
        # A chunk ends at a multiple of 4 bytes: JSON is filled up with spaces, binary data with zeros.
        for kind, content, filler in ((b"JSON", text, b" "), (b"BIN\0", bytes(self.binary), b"\0")):
            padded = content + filler * (-len(content) % 4)
            chunks += struct.pack("<I4s", len(padded), kind) + padded
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
