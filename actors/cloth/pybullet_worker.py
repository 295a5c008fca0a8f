"""The program of an engine's process: one `PyBulletEngine`, driven over standard input and output.

    python -m actors.cloth.pybullet_worker

Each request and each reply is a msgpack map in a frame. The first request lays the cloth on the
table, each later one is a gesture; every reply holds the vertices. The process ends
when its input does. An error ends it too, with a traceback on standard error.
"""

import os
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from actors.cloth.carried import CarriedPaths
from actors.cloth.engine import Film
from actors.cloth.frames import read_frame, write_frame
from actors.cloth.gestures import Gesture, GripperMotion, Hand
from actors.cloth.meshes import ClothMesh
from actors.cloth.pybullet_engine import PyBulletEngine
from actors.cloth.pybullet_settings import PyBulletSettings
from actors.robot.stances import Stance


def serve(requests: int, replies: int) -> None:
    """Answer requests read from one file descriptor on another.

    Raises:
        EOFError: the requests ended.
        BrokenPipeError: nobody reads the replies.
    """
    engine = _engine_with_cloth(msgpack.unpackb(read_frame(requests)))
    film = Film(np.inf)
    while True:
        reply = {
            "vertices": engine.vertices_in_world().tobytes(),
            "film": [frame.tobytes() for frame in film.frames],
        }
        write_frame(replies, msgpack.packb(reply))
        request = msgpack.unpackb(read_frame(requests))
        film = Film(request["film_every_secs"] or np.inf)
        engine.perform(_gesture(request), film if request["film_every_secs"] else None)


def main() -> None:
    """Serve the owner until it is gone; whatever a library prints goes to standard error."""
    replies = os.dup(1)
    os.dup2(2, 1)
    try:
        serve(requests=0, replies=replies)
    except (BrokenPipeError, EOFError):
        return


def _engine_with_cloth(request: dict[str, Any]) -> PyBulletEngine:
    stance = None if request["stance"] is None else Stance(**request["stance"])
    engine = PyBulletEngine(PyBulletSettings(**request["settings"]), stance)
    faces = np.frombuffer(request["faces"], dtype=np.int32).reshape(-1, 3)
    mesh = ClothMesh(_points(request["mesh_vertices"]), faces)
    engine.reset(mesh, _points(request["vertices"]))
    return engine


def _gesture(request: dict[str, Any]) -> Gesture:
    hands = [
        Hand(
            np.array(hand["grasped"], dtype=np.int64),
            np.array(hand["stations"]),
            None if hand["turns"] is None else np.array(hand["turns"]),
            tuple(hand["axis"]),
        )
        for hand in request["hands"]
    ]
    paths = None if request["paths"] is None else CarriedPaths.from_wire(request["paths"])
    return Gesture(tuple(hands), GripperMotion(**request["motion"]), paths)


def _points(raw: bytes) -> NDArray[np.float64]:
    return np.frombuffer(raw, dtype=np.float64).reshape(-1, 3)


if __name__ == "__main__":
    main()
