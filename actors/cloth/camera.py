"""The camera over the table."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Camera:
    """A pinhole camera that looks straight down at the middle of the table.

    Picture frame: x to the right, y down, in pixels from the picture's top left corner; pixel
    (row i, column j) is the square from (j, i) to (j + 1, i + 1).
    """

    size_px: int = 84
    """Width and height of the picture."""

    view_half_width_m: float = 0.26
    """Half the width of the piece of table that the picture shows.

    A flat handkerchief of 0.3 m then covers a third of the picture. **assumed**
    """

    height_m: float = 1.2
    """Height of the pinhole above the table."""

    def __post_init__(self) -> None:
        """Check each number.

        Raises:
            ValueError: a number is not positive.
        """
        for name in ("size_px", "view_half_width_m", "height_m"):
            value = getattr(self, name)
            if not 0 < value < np.inf:
                raise ValueError(
                    f"Camera.{name}: expected a positive number; got {value}; "
                    f"the default is {getattr(Camera, name)}"
                )

    @property
    def px_per_m(self) -> float:
        """Pixels to a metre of the table."""
        return self.size_px / (2.0 * self.view_half_width_m)

    def project_px(self, points_in_world: NDArray[np.float64]) -> NDArray[np.float64]:
        """Where points of the world are seen.

        Args:
            points_in_world: f64[..., 3], metres, below the camera.

        Returns:
            f64[..., 2], x and y in pixels; outside 0 to `size_px` they are out of the picture.
        """
        enlarged = self.height_m / (self.height_m - points_in_world[..., 2])
        x_px = (self.view_half_width_m + points_in_world[..., 0] * enlarged) * self.px_per_m
        y_px = (self.view_half_width_m - points_in_world[..., 1] * enlarged) * self.px_per_m
        return np.stack([x_px, y_px], axis=-1)

    def table_point_m(self, point_px: tuple[float, float]) -> tuple[float, float]:
        """The point of the table's top, x and y in metres, that is seen at a point in pixels."""
        x_m = point_px[0] / self.px_per_m - self.view_half_width_m
        y_m = self.view_half_width_m - point_px[1] / self.px_per_m
        return x_m, y_m
