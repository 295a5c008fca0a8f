"""The program of an engine's process: one `PyBulletEngine`, driven over standard input and output.

    python -m actors.cloth.pybullet_worker

Each request and each reply is a msgpack map in a frame. The first request lays the cloth on the
table, each later one picks it up and drops it; every reply holds the vertices. The process ends
when its input does. An error ends it too, with a traceback on standard error.
"""

import os
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from actors.cloth.frames import read_frame, write_frame
from actors.cloth.gripper import GripperMotion
from actors.cloth.meshes import ClothMesh
from actors.cloth.pybullet_engine import PyBulletEngine
from actors.cloth.pybullet_settings import PyBulletSettings


def serve(requests: int, replies: int) -> None:
    """Answer requests read from one file descriptor on another.

    Raises:
        EOFError: the requests ended.
        BrokenPipeError: nobody reads the replies.
    """
    engine = _engine_with_cloth(msgpack.unpackb(read_frame(requests)))
    while True:
        write_frame(replies, msgpack.packb({"vertices": engine.vertices_in_world().tobytes()}))
        request = msgpack.unpackb(read_frame(requests))
        x_m, y_m = request["drop_xy_m"]
        engine.pick_and_drop(np.array(request["grasped"], dtype=np.int64), (x_m, y_m))


def main() -> None:
    """Serve the owner until it is gone; whatever a library prints goes to standard error."""
    replies = os.dup(1)
    os.dup2(2, 1)
    try:
        serve(requests=0, replies=replies)
    except (BrokenPipeError, EOFError):
        return


def _engine_with_cloth(request: dict[str, Any]) -> PyBulletEngine:
    engine = PyBulletEngine(
        PyBulletSettings(**request["settings"]), GripperMotion(**request["motion"])
    )
    faces = np.frombuffer(request["faces"], dtype=np.int32).reshape(-1, 3)
    mesh = ClothMesh(_points(request["mesh_vertices"]), faces)
    engine.reset(mesh, _points(request["vertices"]))
    return engine


def _points(raw: bytes) -> NDArray[np.float64]:
    return np.frombuffer(raw, dtype=np.float64).reshape(-1, 3)


if __name__ == "__main__":
    main()
