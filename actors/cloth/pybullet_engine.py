"""The reference engine: PyBullet's deformable cloth, which meets itself as well as the table."""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from actors.cloth.engine import (
    TABLE_HALF_WIDTH_M,
    ClothEngineError,
    Film,
    checked_vertices,
)
from actors.cloth.gestures import Gesture, Hand, hand_paths_in_world
from actors.cloth.meshes import ClothMesh
from actors.cloth.obj_files import write_obj
from actors.cloth.pybullet_settings import PyBulletSettings
from actors.cloth.quiet_pybullet import pybullet
from actors.robot.body import RobotBody
from actors.robot.model import WITHDRAWN_POSE_RAD
from actors.robot.stances import Stance

TABLE_THICKNESS_M = 0.1
SETTLE_AFTER_RESET_SECS = 0.05


@dataclass
class PyBulletEngine:
    """Cloth in a PyBullet world of its own, in this process, without a window.

    It cannot save and restore a state. Nor does `reset` make it repeat itself: the order in which
    PyBullet lets the cloth's layers push each other follows a random sequence that belongs to the
    process and is never rewound. `PyBulletProcessEngine` repeats itself.
    """

    settings: PyBulletSettings = field(default_factory=PyBulletSettings)

    stance: Stance | None = None
    """Where a robot stands in the same world; None: there is none."""

    def __post_init__(self) -> None:
        """Begin without a world; `reset` makes it."""
        self._client: int | None = None
        self._robot: RobotBody | None = None
        self._cloth = -1
        self._mesh: ClothMesh | None = None

    @property
    def mesh(self) -> ClothMesh:
        """The cloth at rest.

        Raises:
            ClothEngineError: before the first reset.
        """
        if self._mesh is None:
            raise ClothEngineError(
                "PyBulletEngine: expected reset() first; got no cloth; call reset(mesh)"
            )
        return self._mesh

    def reset(self, mesh: ClothMesh, vertices_in_world: NDArray[np.float64] | None = None) -> None:
        """Put a new piece of cloth on an empty table; see `ClothEngine.reset`."""
        vertices = checked_vertices(mesh, vertices_in_world)
        # PyBullet lays the cloth's middle surface a margin above whatever it touches.
        vertices[:, 2] += self.settings.collision_margin_m
        self._empty_world()
        self._add_table()
        self._robot = self._new_robot()
        self._cloth = self._load(mesh)
        self._mesh = mesh
        pybullet.resetMeshData(self._cloth, vertices.tolist(), physicsClientId=self._client)
        self._simulate(SETTLE_AFTER_RESET_SECS)

    def vertices_in_world(self) -> NDArray[np.float64]:
        """Where the vertices are, f64[V, 3], metres; see `ClothEngine.vertices_in_world`."""
        n_vertices = len(self.mesh.vertices_m)
        _, vertices = pybullet.getMeshData(
            self._cloth,
            -1,
            flags=pybullet.MESH_DATA_SIMULATION_MESH,
            physicsClientId=self._client,
        )
        array = np.array(vertices, dtype=np.float64)
        if array.shape != (n_vertices, 3):
            raise ClothEngineError(
                f"PyBulletEngine: expected {n_vertices} vertices from PyBullet; got "
                f"{list(array.shape)}; another PyBullet than the pinned one merges vertices"
            )
        return array

    def perform(self, gesture: Gesture, film: Film | None = None) -> None:
        """Let hands move the cloth; see `ClothEngine.perform`."""
        gesture.check(len(self.mesh.vertices_m))
        vertices = self.vertices_in_world()
        starts = np.stack([vertices[hand.grasped[0]] for hand in gesture.hands])
        every = None if film is None else max(1, round(film.every_secs / self._step_secs))
        with ExitStack() as held:
            grippers = [
                held.enter_context(self._grasp(hand, start))
                for hand, start in zip(gesture.hands, starts, strict=True)
            ]
            for step, row in enumerate(self._hand_rows(starts, gesture)):
                if film is not None and every is not None and step % every == 0:
                    film.frames.append(self.vertices_in_world())
                for hand, gripper, (*position, turn_rad) in zip(
                    gesture.hands, grippers, row, strict=True
                ):
                    turned = pybullet.getQuaternionFromAxisAngle(hand.turn_axis, turn_rad)
                    pybullet.resetBasePositionAndOrientation(
                        gripper, position, turned, physicsClientId=self._client
                    )
                pybullet.stepSimulation(physicsClientId=self._client)
        if self._robot is not None:
            self._robot.pose(np.array(WITHDRAWN_POSE_RAD))
        self._simulate(gesture.motion.settle_secs)

    def _hand_rows(
        self, starts: NDArray[np.float64], gesture: Gesture
    ) -> Iterator[list[list[float]]]:
        """Position and turn of each hand after each step; a robot in this world is posed first.

        Its fingers' positions are then those that PyBullet finds for its joints.
        """
        rows = hand_paths_in_world(starts, gesture, self._step_secs)
        paths, robot = gesture.paths, self._robot
        if paths is None or robot is None:
            yield from rows.tolist()
            return
        robot.pose(paths.joints_rad[0])
        offsets_m = starts - [robot.fingers_in_world(arm) for arm in paths.arms]
        for row, joints in zip(
            rows, paths.joints_at(paths.steps_secs(self._step_secs)), strict=True
        ):
            robot.pose(joints)
            row[:, :3] = offsets_m + [robot.fingers_in_world(arm) for arm in paths.arms]
            yield row.tolist()

    @property
    def _step_secs(self) -> float:
        return self.settings.time_step_secs

    def close(self) -> None:
        """Give the world back; may be called twice."""
        if self._client is not None:
            pybullet.disconnect(physicsClientId=self._client)
        self._client = None
        self._mesh = None

    def _empty_world(self) -> None:
        if self._client is None:
            self._client = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            self._client = None
            raise ClothEngineError(
                "PyBulletEngine: expected a physics client; got none; close engines you no longer "
                "use, PyBullet allows about a thousand in a process"
            )
        client = self._client
        pybullet.resetSimulation(pybullet.RESET_USE_DEFORMABLE_WORLD, physicsClientId=client)
        pybullet.setGravity(0.0, 0.0, -9.8, physicsClientId=client)
        pybullet.setTimeStep(self.settings.time_step_secs, physicsClientId=client)

    def _add_table(self) -> None:
        # A box: over PyBullet's infinite plane the cloth came to rest 4.6 cm too high.
        half_extents_m = [TABLE_HALF_WIDTH_M, TABLE_HALF_WIDTH_M, TABLE_THICKNESS_M / 2]
        shape = pybullet.createCollisionShape(
            pybullet.GEOM_BOX, halfExtents=half_extents_m, physicsClientId=self._client
        )
        table = pybullet.createMultiBody(
            0, shape, -1, [0.0, 0.0, -TABLE_THICKNESS_M / 2], physicsClientId=self._client
        )
        pybullet.changeDynamics(table, -1, lateralFriction=1.0, physicsClientId=self._client)

    def _new_robot(self) -> RobotBody | None:
        if self.stance is None:
            return None
        assert self._client is not None
        # Not solid: its fingers would push away the very cloth that they hold.
        return RobotBody(self._client, self.stance, solid=False)

    def _load(self, mesh: ClothMesh) -> int:
        settings = self.settings
        with tempfile.TemporaryDirectory(prefix="clothbus-") as folder:
            path = Path(folder) / "cloth.obj"
            write_obj(mesh, path)
            return int(
                pybullet.loadSoftBody(
                    str(path),
                    mass=settings.mass_kg,
                    useMassSpring=1,
                    useBendingSprings=1,
                    useNeoHookean=0,
                    springElasticStiffness=settings.elastic_stiffness,
                    springDampingStiffness=settings.damping_stiffness,
                    springDampingAllDirections=0,
                    springBendingStiffness=settings.bending_stiffness,
                    useSelfCollision=1,
                    frictionCoeff=settings.friction,
                    useFaceContact=1,
                    collisionMargin=settings.collision_margin_m,
                    physicsClientId=self._client,
                )
            )

    @contextmanager
    def _grasp(self, hand: Hand, start: NDArray[np.float64]) -> Iterator[int]:
        """A body without mass that holds the vertices, and lets go of them whatever happens."""
        client = self._client
        gripper = pybullet.createMultiBody(
            0, -1, -1, basePosition=start.tolist(), physicsClientId=client
        )
        anchors: list[int] = []
        try:
            for vertex in hand.grasped.tolist():
                anchors.append(
                    pybullet.createSoftBodyAnchor(
                        self._cloth, vertex, gripper, -1, physicsClientId=client
                    )
                )
            yield gripper
        finally:
            for anchor in anchors:
                pybullet.removeConstraint(anchor, physicsClientId=client)
            pybullet.removeBody(gripper, physicsClientId=client)

    def _simulate(self, duration_secs: float) -> None:
        for _ in range(round(duration_secs / self.settings.time_step_secs)):
            pybullet.stepSimulation(physicsClientId=self._client)
