"""The camera over the table."""

from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """A pinhole camera over the table; by default it looks straight down at the table's middle.

    Picture frame: x to the right, y down, in pixels from the picture's top left corner; pixel
    (row i, column j) is the square from (j, i) to (j + 1, i + 1).
    """

    size_px: int = 84
    """Width and height of the picture."""

    view_half_width_m: float = 0.26
    """Half the width of the piece of table that the picture shows, at the point looked at.

    A flat handkerchief of 0.3 m then covers a third of the picture. **assumed**
    """

    height_m: float = 1.2
    """Height of the pinhole above the table."""

    x_m: float = 0.0
    """Where over the table the pinhole is."""

    y_m: float = 0.0
    """Where over the table the pinhole is."""

    target_x_m: float = 0.0
    """The point of the table that is seen in the middle of the picture."""

    target_y_m: float = 0.0
    """The point of the table that is seen in the middle of the picture."""

    roll_rad: float = 0.0
    """How far the camera is turned around its viewing direction, clockwise as it sees."""

    def __post_init__(self) -> None:
        """Check each number.

        Raises:
            ValueError: a size is not positive, or a place is not a number of the room.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            is_size = field.name in ("size_px", "view_half_width_m", "height_m")
            if is_size and not 0 < value < np.inf:
                raise ValueError(
                    f"Camera.{field.name}: expected a positive number; got {value}; "
                    f"the default is {field.default}"
                )
            if not is_size and not abs(value) <= np.pi:
                raise ValueError(
                    f"Camera.{field.name}: expected a number from {-np.pi:.2f} to {np.pi:.2f}; got "
                    f"{value}; the default is {field.default}"
                )

    @property
    def px_per_m(self) -> float:
        """Pixels to a metre of the table, at the point looked at."""
        return self.size_px / (2.0 * self.view_half_width_m)

    @cached_property
    def position_in_world(self) -> NDArray[np.float64]:
        """The pinhole, f64[3], metres."""
        return np.array([self.x_m, self.y_m, self.height_m])

    @cached_property
    def rotation_from_world(self) -> NDArray[np.float64]:
        """f64[3, 3], in the world: the picture's right, its down, the viewing direction."""
        forward = np.array([self.target_x_m, self.target_y_m, 0.0]) - self.position_in_world
        forward /= np.linalg.norm(forward)
        right = np.cross(forward, [0.0, 1.0, 0.0])
        right /= np.linalg.norm(right)
        down = np.cross(forward, right)
        cosine, sine = np.cos(self.roll_rad), np.sin(self.roll_rad)
        return np.stack([cosine * right + sine * down, cosine * down - sine * right, forward])

    @cached_property
    def intrinsics(self) -> NDArray[np.float64]:
        """f64[3, 3], focal lengths and principal point in pixels, as OpenCV has them."""
        target = np.array([self.target_x_m, self.target_y_m, 0.0])
        distance_m = float(np.linalg.norm(target - self.position_in_world))
        focal_px = self.px_per_m * distance_m
        return np.array(
            [
                [focal_px, 0.0, self.size_px / 2],
                [0.0, focal_px, self.size_px / 2],
                [0.0, 0.0, 1.0],
            ]
        )

    def depths_m(self, points_in_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Distances along the viewing direction, f64[...], of points f64[..., 3]."""
        offsets = points_in_world - self.position_in_world
        return np.asarray(offsets @ self.rotation_from_world[2])

    def project_px(self, points_in_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where points of the world are seen.

        Args:
            points_in_world: f64[..., 3], metres, before the camera.

        Returns:
            f64[..., 2], x and y in pixels; outside 0 to `size_px` they are out of the picture.
        """
        seen = (points_in_world - self.position_in_world) @ self.rotation_from_world.T
        focal_px = self.intrinsics[0, 0]
        return np.asarray(seen[..., :2] / seen[..., 2:] * focal_px + self.size_px / 2)

    def table_points_m(self, points_px: NDArray[np.floating]) -> NDArray[np.float64]:
        """The points of the table's top, f64[n, 2], that are seen at points [n, 2] in pixels."""
        directions = np.empty((len(points_px), 3))
        directions[:, :2] = (points_px - self.size_px / 2) / self.intrinsics[0, 0]
        directions[:, 2] = 1.0
        rays = directions @ self.rotation_from_world
        portions = -self.height_m / rays[:, 2:]
        return np.asarray(self.position_in_world[:2] + portions * rays[:, :2])

    def table_point_m(self, point_px: tuple[float, float]) -> tuple[float, float]:
        """The point of the table's top, x and y in metres, that is seen at a point in pixels."""
        ((x_m, y_m),) = self.table_points_m(np.array([point_px], dtype=np.float64)).tolist()
        return x_m, y_m
