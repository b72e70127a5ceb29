"""The surface of a body as one animated glTF file (.glb)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from masiv.export.libraries import require_library
from masiv.export.surface import carried_surface, to_y_up
from masiv.files import write_bytes
from masiv.progress import Progress, silent

if TYPE_CHECKING:
    import pygltflib

    from masiv.simulation.rollout import Rollout

Y_UP = (0.0, 1.0, 0.0)
COLOR = [0.8, 0.45, 0.15, 1.0]
ROUGHNESS = 0.7


def write_glb(
    rollout: Rollout,
    path: str | Path,
    *,
    up: np.ndarray | tuple[float, float, float] = Y_UP,
    spacing: float | None = None,
    progress: Progress = silent,
) -> None:
    """Write the moving surface of ``rollout`` to ``path`` (.glb, glTF 2.0).

    One mesh: ``carried_surface``, the surface of frame 0 whose vertices follow the particles. Each later frame is a
    morph target with positions and normals; an animation fades from one to the next, so that the frames are met at
    their times [s] and between them a vertex moves in a straight line. glTF is y up: ``up`` (3,) of the world is turned
    to +y. spacing [m]: see ``reconstruct_surface``. Raises InputError if a library is missing or there is no surface.
    """
    require_library("pygltflib", "glTF files")
    turn = to_y_up(np.asarray(up, np.float64)).T
    frames: list[tuple[np.ndarray, np.ndarray]] = []
    triangles = np.zeros((0, 3), np.int32)
    for surface in carried_surface(rollout.positions, spacing):
        triangles = surface.triangles
        frames.append(((surface.vertices @ turn).astype(np.float32), (surface.normals @ turn).astype(np.float32)))
        progress("export", len(frames), len(rollout.positions))
    write_bytes(Path(path), _document(frames, triangles, rollout.times))


def _document(frames: list[tuple[np.ndarray, np.ndarray]], triangles: np.ndarray, times: np.ndarray) -> bytes:
    import pygltflib as gltf

    buffer = _Buffer()
    vertices, normals = frames[0]
    attributes = gltf.Attributes(
        POSITION=buffer.add(vertices, gltf.ARRAY_BUFFER, bounds=True), NORMAL=buffer.add(normals, gltf.ARRAY_BUFFER)
    )
    indices = buffer.add(triangles.astype(np.uint32).ravel(), gltf.ELEMENT_ARRAY_BUFFER)
    targets = [
        gltf.Attributes(
            POSITION=buffer.add(moved - vertices, gltf.ARRAY_BUFFER, bounds=True),
            NORMAL=buffer.add(turned - normals, gltf.ARRAY_BUFFER),
        )
        for moved, turned in frames[1:]
    ]
    primitive = gltf.Primitive(attributes=attributes, indices=indices, material=0, targets=targets or None)
    animations = []
    if targets:
        # At frame k the weight of target k - 1 is one and all others are zero; frame 0 has none.
        weights = np.eye(len(frames), dtype=np.float32)[:, 1:]
        sampler = gltf.AnimationSampler(
            input=buffer.add(np.asarray(times, np.float32), None, bounds=True),
            output=buffer.add(weights.ravel(), None),
            interpolation=gltf.ANIM_LINEAR,
        )
        target = gltf.AnimationChannelTarget(node=0, path="weights")
        channel = gltf.AnimationChannel(sampler=0, target=target)
        animations.append(gltf.Animation(name="motion", samplers=[sampler], channels=[channel]))
    look = gltf.PbrMetallicRoughness(baseColorFactor=COLOR, metallicFactor=0.0, roughnessFactor=ROUGHNESS)
    document = gltf.GLTF2(
        asset=gltf.Asset(version="2.0", generator="masiv"),
        scene=0,
        scenes=[gltf.Scene(nodes=[0])],
        nodes=[gltf.Node(name="body", mesh=0)],
        meshes=[gltf.Mesh(name="body", primitives=[primitive], weights=[0.0] * len(targets) or None)],
        materials=[gltf.Material(name="body", pbrMetallicRoughness=look)],
        animations=animations,
        accessors=buffer.accessors,
        bufferViews=buffer.views,
        buffers=[gltf.Buffer(byteLength=len(buffer.data))],
    )
    document.set_binary_blob(bytes(buffer.data))
    return b"".join(document.save_to_bytes())


class _Buffer:
    """The binary part of the file, with a view and an accessor for each array."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[pygltflib.BufferView] = []
        self.accessors: list[pygltflib.Accessor] = []

    def add(self, array: np.ndarray, target: int | None, *, bounds: bool = False) -> int:
        """Append ``array``, float32 or uint32 with one or three columns; its accessor's index."""
        import pygltflib as gltf

        array = np.ascontiguousarray(array)
        view = gltf.BufferView(buffer=0, byteOffset=len(self.data), byteLength=array.nbytes, target=target)
        self.views.append(view)
        self.data += array.tobytes()  # of 4-byte numbers: the next offset is aligned
        kind: dict[str, Any] = {"type": gltf.VEC3 if array.ndim == 2 else gltf.SCALAR}
        kind["componentType"] = gltf.FLOAT if array.dtype == np.float32 else gltf.UNSIGNED_INT
        if bounds:
            columns = array.reshape(len(array), -1)
            kind |= {"min": columns.min(axis=0).tolist(), "max": columns.max(axis=0).tolist()}
        self.accessors.append(gltf.Accessor(bufferView=len(self.views) - 1, count=len(array), **kind))
        return len(self.accessors) - 1
