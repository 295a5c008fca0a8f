"""PyBullet in a process of its own, a fresh one at each reset.

Two things are gained for about a quarter of a second at each reset. The cloth repeats itself bit
by bit, although PyBullet keeps a random sequence that nothing rewinds but a new process. And a
simulator that crashes or hangs takes nothing with it.
"""

import os
import subprocess
import sys
import tempfile
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import IO, Any, NoReturn

import msgpack
import numpy as np
from numpy.typing import NDArray

from actors.cloth.engine import ClothEngineError, Film, checked_vertices
from actors.cloth.frames import read_frame, write_frame
from actors.cloth.gestures import Gesture
from actors.cloth.meshes import ClothMesh
from actors.cloth.pybullet_settings import PyBulletSettings
from actors.robot.stances import Stance

REPLY_TIMEOUT_SECS = 120.0  # an action takes half a second; a crowded machine, some seconds
_PACKAGES = Path(__file__).resolve().parents[2]


@dataclass
class PyBulletProcessEngine:
    """A `ClothEngine`: the cloth of `PyBulletEngine`, exactly repeatable and out of harm's way.

    The same mesh, vertices and sequence of gestures give the same vertices, bit by bit, in every
    process on one type of CPU. It cannot save and restore a state.
    """

    settings: PyBulletSettings = field(default_factory=PyBulletSettings)
    stance: Stance | None = None
    """Where a robot stands in the cloth's world; None: there is none."""

    reply_timeout_secs: float = REPLY_TIMEOUT_SECS

    def __post_init__(self) -> None:
        """Begin without a process; `reset` starts it."""
        self._worker: subprocess.Popen[bytes] | None = None
        self._complaints: IO[bytes] | None = None
        self._mesh: ClothMesh | None = None
        self._vertices = np.empty((0, 3))

    @property
    def mesh(self) -> ClothMesh:
        """The cloth at rest.

        Raises:
            ClothEngineError: before the first reset.
        """
        if self._mesh is None:
            raise ClothEngineError(
                "PyBulletProcessEngine: expected reset() first; got no cloth; call reset(mesh)"
            )
        return self._mesh

    @property
    def process_id(self) -> int | None:
        """The simulator's process while there is one."""
        return None if self._worker is None else self._worker.pid

    def reset(self, mesh: ClothMesh, vertices_in_world: NDArray[np.float64] | None = None) -> None:
        """Replace the process by a fresh one; see `ClothEngine.reset`."""
        vertices = checked_vertices(mesh, vertices_in_world)
        self.close()
        self._start()
        self._ask(
            {
                "settings": asdict(self.settings),
                "stance": None if self.stance is None else asdict(self.stance),
                "mesh_vertices": mesh.vertices_m.tobytes(),
                "faces": mesh.faces.tobytes(),
                "vertices": vertices.tobytes(),
            }
        )
        self._mesh = mesh

    def vertices_in_world(self) -> NDArray[np.float64]:
        """Where the vertices are, f64[V, 3], metres; see `ClothEngine.vertices_in_world`."""
        assert len(self._vertices) == len(self.mesh.vertices_m)
        return self._vertices.copy()

    def perform(self, gesture: Gesture, film: Film | None = None) -> None:
        """Let hands move the cloth; see `ClothEngine.perform`."""
        gesture.check(len(self.mesh.vertices_m))
        hands = [
            {
                "grasped": hand.grasped.tolist(),
                "stations": hand.stations_in_world.tolist(),
                "turns": None if hand.turns_rad is None else hand.turns_rad.tolist(),
                "axis": hand.turn_axis,
            }
            for hand in gesture.hands
        ]
        frames = self._ask(
            {
                "hands": hands,
                "motion": asdict(gesture.motion),
                "paths": None if gesture.paths is None else gesture.paths.to_wire(),
                "film_every_secs": None if film is None else film.every_secs,
            }
        )
        if film is not None:
            film.frames += frames

    def close(self) -> None:
        """End the process; may be called twice."""
        worker, self._worker = self._worker, None
        self._mesh = None
        if worker is not None:
            worker.kill()  # it holds nothing that a polite end would save
            worker.communicate()
        if self._complaints is not None:
            self._complaints.close()
            self._complaints = None

    def _start(self) -> None:
        self._complaints = tempfile.TemporaryFile()  # noqa: SIM115 - it lives as long as the process
        python_path = os.pathsep.join(
            [str(_PACKAGES), *filter(None, [os.environ.get("PYTHONPATH")])]
        )
        try:
            self._worker = subprocess.Popen(
                [sys.executable, "-P", "-m", "actors.cloth.pybullet_worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=self._complaints,
                env={**os.environ, "PYTHONPATH": python_path},
                # An interrupt from the terminal is for the owner alone. Not a session of its own:
                # the kernel shares time among sessions, so that it would not have our low priority.
                process_group=0,
                bufsize=0,
            )
        except OSError as error:
            self.close()
            raise ClothEngineError(
                f"PyBulletProcessEngine: expected to start {sys.executable}; got {error}; "
                "check the limits on processes and open files"
            ) from error

    def _ask(self, request: dict[str, Any]) -> list[NDArray[np.float64]]:
        """Send a request, take the vertices from its reply, and return what was filmed."""
        worker = self._worker
        assert worker is not None
        assert worker.stdin is not None
        assert worker.stdout is not None
        try:
            write_frame(worker.stdin.fileno(), msgpack.packb(request))
            reply = msgpack.unpackb(read_frame(worker.stdout.fileno(), self.reply_timeout_secs))
            self._vertices = np.frombuffer(reply["vertices"]).reshape(-1, 3)
            return [np.frombuffer(frame).reshape(-1, 3) for frame in reply["film"]]
        except TimeoutError as error:
            self._lost(f"no answer within {self.reply_timeout_secs:g} s", error)
        except (BrokenPipeError, EOFError, ValueError, KeyError) as error:
            self._lost("the end of its process", error)
        except BaseException:
            self.close()  # interrupted halfway: the next answer would belong to this request
            raise

    def _lost(self, what: str, error: Exception) -> NoReturn:
        last_words = self._last_words()
        self.close()
        raise ClothEngineError(
            f"PyBulletProcessEngine: expected the simulator's answer; got {what}"
            f"{last_words}; reset() starts it anew"
        ) from error

    def _last_words(self) -> str:
        if self._complaints is None:
            return ""
        self._complaints.seek(0)
        lines = self._complaints.read().decode("utf-8", "replace").strip().splitlines()
        return f" ({lines[-1]})" if lines else ""
